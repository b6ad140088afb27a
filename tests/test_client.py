"""What the command line makes of what is typed, and of what comes from Zenoh."""

from dataclasses import replace
from pathlib import Path

import pytest

from gateway.client import connected, parse_value, wanted_keys
from gateway.config import Config, load
from gateway.errors import ConfigError, GatewayError
from tests.e2e.processes import vigor_line, write_config
from tests.zenoh_peer import free_endpoint


@pytest.fixture
def config(tmp_path: Path) -> Config:
    tags = {"speed": {"address": "D10"}, "alarms/door": {"address": "M12"}}
    lines = {"hall": vigor_line("simulator", tags)}
    return load(write_config(tmp_path / "config.yaml", free_endpoint(), lines))


@pytest.mark.parametrize(
    ("typed", "value"),
    [
        ("12", 12),
        ("-3.5", -3.5),
        ("true", True),
        ('"12"', "12"),
        ("AB", "AB"),
        ("", ""),
        ("[1]", "[1]"),
        ("null", "null"),
        ('{"value": 1}', '{"value": 1}'),
        ("NaN", "NaN"),
        ("-Infinity", "-Infinity"),
        ("1e999", "1e999"),
        ("9" * 5000, "9" * 5000),
    ],
)
def test_a_typed_value_is_a_json_scalar_or_text(typed: str, value: object) -> None:
    parsed = parse_value(typed)
    assert parsed == value
    assert type(parsed) is type(value)


@pytest.mark.parametrize(
    ("names", "keys"),
    [
        (None, ["**"]),
        ([], ["**"]),
        (["mixer"], ["mixer/**"]),
        (["mixer/speed"], ["mixer/speed"]),
        (["mixer/alarms/door", "mixer/*"], ["mixer/alarms/door", "mixer/*"]),
        (["**/door"], ["**/door"]),
    ],
)
def test_names_become_keys(config: Config, names: list[str] | None, keys: list[str]) -> None:
    assert wanted_keys(config, names) == keys


@pytest.mark.parametrize(
    "name", ["mixer/sped", "oven", "*/sped", "", "/", "mixer/", "mixer//speed", "a?b", "a#b", "***"]
)
def test_names_that_mean_nothing(config: Config, name: str) -> None:
    with pytest.raises(ConfigError):
        wanted_keys(config, ["mixer/speed", name])


def test_no_way_to_the_gateway(config: Config) -> None:
    nowhere = replace(config, zenoh=replace(config.zenoh, listen=(), connect=()))
    with pytest.raises(GatewayError, match="no way to the gateway"), connected(nowhere):
        pass
