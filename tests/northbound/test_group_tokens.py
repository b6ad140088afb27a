"""Tokens of a standby group count if they are signed with its secret."""

import pytest
from structlog.testing import capture_logs

from gateway.contract.keys import Keys
from gateway.northbound.group.election import Role, RoleToken
from gateway.northbound.group.plant_secret import PlantSecret
from gateway.northbound.group.standby import GroupTokens

ACTIVE = RoleToken(Role.ACTIVE, "a", "5e55")
SECRET = PlantSecret("a secret of twenty or more")
LEFT, RIGHT = (GroupTokens(Keys("plant", name), "hall", SECRET) for name in ("a", "b"))


def test_a_gateway_of_the_group_knows_the_tokens_of_the_other() -> None:
    for token in (ACTIVE, ACTIVE._replace(role=Role.CLAIM)):
        assert RIGHT.parse(LEFT.key(token), 0.0) == token


@pytest.mark.parametrize(
    "key",
    [
        "plant/@standby/hall/active/a/5e55",
        "plant/@standby/hall/active/a/5e55/" + "0" * 32,
        LEFT.key(ACTIVE._replace(role=Role.CLAIM)).replace("claim", "active"),
        LEFT.key(ACTIVE._replace(name="b")).replace("/b/", "/a/"),
        LEFT.key(ACTIVE._replace(session="0")).replace("/0/", "/5e55/"),
        LEFT.key(ACTIVE) + "/more",
        GroupTokens(Keys("plant", "a"), "yard", SECRET).key(ACTIVE).replace("yard", "hall"),
        "plant/@standby/hall/king/a/5e55",
        "plant/@standby/hall/active",
    ],
)
def test_a_forged_token_is_refused_and_named(key: str) -> None:
    with capture_logs() as logs:
        assert RIGHT.parse(key, 1e9) is None
    assert [(entry["event"], entry["token"]) for entry in logs] == [("standby token refused", key)]


def test_without_a_secret_every_token_of_the_group_counts() -> None:
    without = GroupTokens(Keys("plant", "b"), "hall", None)
    assert without.parse("plant/@standby/hall/active/a/5e55", 0.0) == ACTIVE
    assert without.parse(without.key(ACTIVE), 0.0) == ACTIVE
    assert without.parse(LEFT.key(ACTIVE), 0.0) == ACTIVE  # of a gateway with a secret


def test_a_flood_of_forged_tokens_is_logged_a_few_times() -> None:
    tokens = GroupTokens(Keys("plant", "b"), "hall", SECRET)
    with capture_logs() as logs:
        for number in range(1000):
            assert tokens.parse(f"plant/@standby/hall/active/a/{number}", 0.0) is None
    assert len(logs) <= 10
