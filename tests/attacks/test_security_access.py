"""docs/access-control.md: the rules of the page, and every user that tries what they forbid."""

import asyncio
import json
import re
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from gateway.parts.alarms.own_faults import FAULTS
from tests.attacks.security_pages import (
    RULES,
    VALUES,
    client,
    plant_file,
    quoted,
    refusal,
    serving,
    table,
    units,
    user_of,
)
from tests.e2e.processes import Program, free_port
from tests.northbound.access import GATEWAY_RULES, ROUTER_RULES, rules, secret
from tests.zenoh_peer import Subscription, ZenohPeer

RECIPE, DIAL = "plant/mixer/recipe/@set", "plant/oven/dial/@set"
GROUP = "plant/mixer/@set"
LOOPBACK, GLOBAL = "plant/oven/@loopback", "plant/@gateway/demo/lines/annex/global"
STATUS = "plant/@gateway/demo/status"
ALARMS = "plant/@gateway/demo/alarms"
ALARM = f"{ALARMS}/mixer/speed"
BY = b'{"by": "Ana"}'
FORGED = b'{"value": "forged", "quality": "good", "time": "2026-11-20T12:00:00Z"}'


class Rights(NamedTuple):
    """The keys with a request that the gateway answers."""

    reads: bool
    writes: tuple[str, ...] = ()
    acknowledges: bool = True


# The users of the page, and those of its section on other rights.
USERS = {
    "viewer": Rights(True, acknowledges=False),
    "operator": Rights(True, (RECIPE, DIAL, GROUP)),
    "health": Rights(False, acknowledges=False),
    "commander": Rights(True, (LOOPBACK, GLOBAL)),
    "mixer-operator": Rights(True, (RECIPE, GROUP)),
    "recipe-operator": Rights(True, (RECIPE,)),
}


def with_other_rights(page_rules: str) -> dict[str, Any]:
    """Returns the rules of the page with three users more, as the page explains."""
    found: dict[str, Any] = rules(page_rules)
    kept, like_write, like_outcome, _, _, described, one_device, some_tags = [
        re.findall(r"`([^`]+)`", unit.text)
        for unit in units(RULES)
        if unit.section == "Other rights"
    ][1:]

    def copied(rule: str, name: str, keys: list[str]) -> str:
        [model] = [each for each in found["rules"] if each["id"] == rule]
        found["rules"].append({**model, "id": name, "key_exprs": keys})
        return name

    def permit(user: str, names: list[str]) -> None:
        found["subjects"].append({"id": user, "usernames": [user]})
        found["policies"].append({"rules": names, "subjects": [user]})

    commands = like_write[1:]
    assert (like_write[0], like_outcome, len(commands)) == ("write", ["outcome"], 4)
    own = [copied(rule, f"commands-{rule}", commands) for rule in ("write", "outcome")]
    permit("commander", kept + own)
    *keys, ask, tell, offer, asked = described
    for each in found["rules"]:
        if each["id"] in (ask, tell, offer, asked):
            each["key_exprs"] = [*each["key_exprs"], *keys]
    only, all_of_them, rule, kept_rule = one_device
    assert [all_of_them] == next(r["key_exprs"] for r in found["rules"] if r["id"] == rule)
    others = next(policy["rules"] for policy in found["policies"] if "ask" in policy["rules"])
    permit("mixer-operator", [*others, copied(rule, "write-mixer", [only]), kept_rule])
    assert some_tags == [GROUP, only, RECIPE]
    permit("recipe-operator", [*others, copied(rule, "write-recipe", [RECIPE]), kept_rule])
    return found


def group_of(value: bytes) -> bytes:
    return b'{"recipe": %b}' % value


def password_of(name: str) -> str:
    return f"of-{name}-5f0c1"


def users_file(folder: Path) -> Path:
    names = (*USERS, "gateway")
    return secret(folder / "users.txt", "".join(f"{n}:{password_of(n)}\n" for n in names))


@asynccontextmanager
async def by_itself(folder: Path) -> AsyncIterator[tuple[Program, str]]:
    control = with_other_rights(GATEWAY_RULES)
    (folder / "access.json5").write_text(json.dumps({"access_control": control}))
    quoted("`zenoh.config_file: access.json5` beside `users_file`", RULES)
    users_file(folder)
    port = free_port()
    settings = "{listen: [tcp/127.0.0.1:7447], users_file: users.txt, config_file: access.json5}"
    path = plant_file(folder, f"zenoh: {settings}\n", port, control=True)
    with await asyncio.to_thread(serving, path) as program:
        yield program, f"tcp/127.0.0.1:{port}"


@asynccontextmanager
async def behind_a_router(folder: Path) -> AsyncIterator[tuple[Program, str]]:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    config = {
        "access_control": with_other_rights(ROUTER_RULES),
        "transport/auth/usrpwd/dictionary_file": str(users_file(folder)),
    }
    secret(folder / "password.txt", password_of("gateway"))
    own = "user: gateway, password_file: password.txt"
    path = plant_file(
        folder, f"zenoh: {{listen: [], connect: [{endpoint}], {own}}}\n", control=True
    )
    async with ZenohPeer("router", listen=[endpoint], config=config):
        with await asyncio.to_thread(serving, path) as program:
            yield program, endpoint


@pytest.mark.parametrize("guarded", [by_itself, behind_a_router])
async def test_every_user_does_what_the_page_says_and_nothing_else(
    guarded: Callable[[Path], Any], tmp_path: Path
) -> None:
    assert {row[0].strip("`") for row in table(TITLE, RULES)} <= {*USERS, "gateway"}
    async with guarded(tmp_path) as (program, endpoint), AsyncExitStack() as sessions:
        for attacker in ({}, user_of("operator", password_of("viewer"))):
            assert await asyncio.to_thread(refusal, endpoint, attacker)
        people = {
            name: await sessions.enter_async_context(
                client(endpoint, user_of(name, password_of(name)))
            )
            for name in USERS
        }
        observer = user_of("viewer", password_of("viewer"))
        viewer = await sessions.enter_async_context(client(endpoint, observer))
        await viewer.until_alive("plant/@gateway/*", ["plant/@gateway/demo"])
        tokens = await viewer.liveliness("plant/@gateway/**")
        heard = [await viewer.subscribe(key) for key in ("plant/**", "plant/*/@block")]
        outcomes = await viewer.subscribe("plant/@gateway/**")
        for name, person in people.items():
            await reads(person, USERS[name])
        stolen = [await forges(person) for person in people.values()]
        before = len(program.lines)
        values = dict(zip(USERS, (b"11", b"12", b"13", b"14", b"15", b"16"), strict=True))
        for name, person in people.items():
            await asks(person, USERS[name], values[name])
        refused = await people["operator"].get("plant/**/@set", values["operator"])
        assert [reply.json["error"] for reply in refused] == ["unknown-tag"]
        await viewer.get(STATUS)
        await outcomes.next(lambda sample: sample.key.endswith("/writes"))
        # No forged message, token or queryable reached anybody.
        asked = [line for line in program.lines[before:] if "tag written" in line]
        asked += [line for line in program.lines[before:] if "command executed" in line]
        assert len(asked) == sum(len(rights.writes) for rights in USERS.values())
        assert not program.has_said("forged")
        for queries, own in zip(stolen, values.values(), strict=True):
            assert {sample.payload for sample in queries.samples} <= {own, group_of(own)}
        received = [sample for each in (*heard, outcomes) for sample in each.samples]
        assert not any(
            b"forged" in sample.payload or sample.kind == "DELETE" for sample in received
        )
        assert not any("evil" in token.key for token in tokens.samples)
        [status] = await viewer.get(STATUS)
        assert status.json["refused_devices"] == {}


TITLE = "Restrict clients with Zenoh's access control"


async def reads(person: ZenohPeer, rights: Rights) -> None:
    """Reads everything, or the status only."""
    for selector, count in (
        ("plant/**", VALUES),
        ("plant/**/@meta", VALUES),
        ("plant/*/@block", 1),
        ("plant/@gateway/demo/lines/*", 2),
        ("plant/@gateway/demo/@describe", 1),
        ("plant/@gateway/*/@introspect", 1),
        (f"{STATUS[:-6]}audit/*?_time=[now(-1h)..]", 0),  # the file keeps none
        # Of a tag, two devices, two lines, and the faults of the gateway itself.
        (f"{ALARMS}/**", 5 + len(FAULTS)),
        ("plant/mixer/speed?max_age=1h", 1),
        ("**", 0),
    ):
        replies = await person.get(selector, consolidation="NONE")
        assert len(replies) == (count if rights.reads else 0), selector
    assert len(await person.get(STATUS)) == 1
    late = await person.subscribe("plant/**", advanced=True)
    if rights.reads:
        await late.until(lambda of: len(of.latest()) == VALUES)
        await person.until_alive("plant/@gateway/*", ["plant/@gateway/demo"])
    else:
        assert await person.tokens("plant/@gateway/**") == []


async def forges(person: ZenohPeer) -> Subscription:
    """Publishes, declares and claims as if it were a gateway. Returns the queries that it got."""
    for key in (
        "plant/mixer/speed",
        "plant/oven/@block",
        "plant/mixer/speed/@meta",
        "plant/@gateway/demo/status",
        "plant/@gateway/demo/writes",
        "plant/**",
        "**",
        RECIPE,  # a plain put is denied to all
        "plant/**/@set",
    ):
        await person.put(key, FORGED)
        await person.delete(key)
    for token in (
        "plant/@gateway/evil",
        "plant/@gateway/evil/claim/f00d",
        "plant/@gateway/demo/alive/evil",
        "plant/@standby/hall/active/a/f00d",
    ):
        await person.declare_token(token)
    for key in ("plant/mixer/speed", "plant/@gateway/*/claim/*", "plant/@gateway/demo/**"):
        await person.queryable(key)
    return await person.queryable("plant/**/@set")


async def asks(person: ZenohPeer, rights: Rights, value: bytes) -> None:
    """Writes and commands on every key. The gateway answers the allowed ones."""
    group = group_of(value)
    requests = {RECIPE: value, DIAL: value, GROUP: group, LOOPBACK: b"AB", GLOBAL: b"on"}
    requests["plant/mixer/@peek"] = b"D100"  # the page allows it to nobody
    for key, data in requests.items():
        replies = await person.get(key, data, target="ALL")
        assert [reply.ok for reply in replies] == ([True] if key in rights.writes else []), key
    replies = await person.get(ALARM, BY, target="ALL")
    assert [reply.ok for reply in replies] == [True] * rights.acknowledges
    for key in (f"{ALARMS}/*/*", f"{ALARMS}/mixer/**", f"{ALARMS}/**"):
        for reply in await person.get(key, BY, target="ALL"):
            assert not reply.ok, key
    if RECIPE not in rights.writes:
        for key in ("plant/mixer/**/@set", "plant/**/@set", "**/@set", "plant/**", "**"):
            replies = await person.get(key, value, target="ALL")
            assert all(reply.ok and reply.key[-4:] != "@set" for reply in replies if reply.key), key


async def test_with_allow_as_default_a_write_to_a_wildcard_arrives(tmp_path: Path) -> None:
    """The gateway refuses it: only a tag that is named in full is written."""
    quoted("With `allow` and a rule against `plant/**/@set`, a write to `**/@set` would", RULES)
    rule = {
        "id": "no",
        "permission": "deny",
        "flows": ["ingress"],
        "messages": ["put", "query"],
        "key_exprs": ["plant/**/@set"],
    }
    control = {
        "enabled": True,
        "default_permission": "allow",
        "rules": [rule],
        "subjects": [{"id": "all"}],
        "policies": [{"rules": ["no"], "subjects": ["all"]}],
    }
    (tmp_path / "access.json5").write_text(json.dumps({"access_control": control}))
    port = free_port()
    settings = "{listen: [tcp/127.0.0.1:7447], config_file: access.json5}"
    with await asyncio.to_thread(serving, plant_file(tmp_path, f"zenoh: {settings}\n", port)):
        async with client(f"tcp/127.0.0.1:{port}") as anyone:
            assert await anyone.get(RECIPE, b"7") == []
            [reply] = await anyone.get("**/@set", b"7")
            assert reply.json["error"] == "unknown-tag"
            assert "has a wildcard" in reply.json["reason"]
