"""Error replies to a Zenoh client in another process."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import pytest

from tests.e2e.processes import Program, started, station, vigor_line, write_config
from tests.zenoh_peer import ZenohPeer, free_endpoint

TAGS = {
    "speed": {"address": "D10"},
    "recipe": {"address": "D500", "write": {"min": 1, "max": 40, "verify": True}},
    "trim": {"address": "D501", "write": True},
    "ratio": {"address": "D502", "type": "float32", "write": True},
    "name": {"address": "D600", "type": "string[4]", "write": True},
    "run": {"address": "Y20", "write": True},
    "absent": {"address": "D700", "write": True},
    "absent-bit": {"address": "M30", "write": True},
}


class Plant(NamedTuple):
    endpoint: str
    plc: Program


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plant]:
    """A PLC that has neither D700 nor M30, and a gateway that polls it."""
    folder = tmp_path_factory.mktemp("plant")
    endpoint = free_endpoint()
    config = write_config(
        folder / "config.yaml", endpoint, {"hall": vigor_line(str(folder / "tty"), TAGS)}
    )
    with station("pty", str(folder / "tty")) as plc:
        plc.tell("hole 1 D 700")
        plc.tell("hole 1 M 30")
        plc.tell("count 1 D 10")
        with started(config):
            yield Plant(endpoint, plc)


@pytest.mark.parametrize(
    ("tag", "payload", "error", "says"),
    [
        ("nobody", b"1", "unknown-tag", "no tag at plant/mixer/nobody"),
        ("*", b"1", "unknown-tag", "wildcard"),
        ("speed", b"1", "not-writable", "mixer/speed may only be read"),
        ("recipe", b"41", "bad-value", "41 is above the greatest value 40"),
        ("recipe", b"0", "bad-value", "0 is below the least value 1"),
        ("trim", b"32768", "bad-value", "32768"),
        ("trim", b"-32769", "bad-value", "-32769"),
        ("trim", b"1.5", "bad-value", "1.5"),
        ("trim", b'"AB"', "bad-value", "AB"),
        ("trim", b"true", "bad-value", "True"),
        ("trim", b"null", "bad-value", "send a JSON value"),
        ("trim", b"[1]", "bad-value", "send no list"),
        ("trim", b"", "bad-value", "empty"),
        ("trim", b"{", "bad-value", "no JSON"),
        ("ratio", b"NaN", "bad-value", "NaN"),
        ("ratio", b"1e39", "bad-value", "1e+39"),
        ("run", b"2", "bad-value", "2"),
        ("run", b'"on"', "bad-value", "on"),
        ("name", b"7", "bad-value", "7"),
        ("name", b'"ABCDE"', "bad-value", "ABCDE"),
    ],
)
async def test_an_invalid_write_sends_nothing(
    plant: Plant, tag: str, payload: bytes, error: str, says: str
) -> None:
    async with ZenohPeer("client", connect=[plant.endpoint]) as client:
        before = await _writes(client)
        [reply] = await client.get(f"plant/mixer/{tag}/@set", payload)
        assert not reply.ok
        assert reply.json["error"] == error
        assert says in reply.json["reason"]
        assert reply.encoding == "application/json"
        assert await _writes(client) == before


@pytest.mark.parametrize(("tag", "payload"), [("absent", b"5"), ("absent-bit", b"true")])
async def test_error_code_28_of_the_plc_is_reported(plant: Plant, tag: str, payload: bytes) -> None:
    async with ZenohPeer("client", connect=[plant.endpoint]) as client:
        told = await client.subscribe("plant/@gateway/demo/writes")
        [reply] = await client.get(f"plant/mixer/{tag}/@set", payload)
        assert not reply.ok
        assert (reply.json["error"], reply.json["code"]) == ("refused", "28")
        assert "data address out of range" in reply.json["reason"]
        outcome = await told.next(lambda s: s.json["key"] == f"plant/mixer/{tag}")
        assert (outcome.json["outcome"], outcome.json["code"]) == ("refused", "28")


async def test_a_bad_address_makes_no_other_tag_bad(plant: Plant) -> None:
    async with ZenohPeer("client", connect=[plant.endpoint]) as client:
        values = await client.get_all_until("plant/mixer/*", _were_all_read)
        bad = {key for key, value in values.items() if value["quality"] == "bad"}
        assert bad == {"plant/mixer/absent", "plant/mixer/absent-bit"}
        assert {values[key]["value"] for key in bad} == {None}
        [device] = await client.get("plant/@gateway/demo/devices/mixer")
        assert device.json["standing"] == "up"
        said = [sentence.partition(" since ")[0] for sentence in device.json["refused_addresses"]]
        assert sorted(said) == ["D700 of mixer: refused with 28", "M30 of mixer: refused with 28"]


def _were_all_read(values: dict[str, Any]) -> bool:
    """A device whose first reply waits is no reason."""
    return {value.get("reason") for value in values.values()} == {None, "refused"}


async def test_a_put_writes_and_its_outcome_is_published(plant: Plant) -> None:
    async with ZenohPeer("client", connect=[plant.endpoint]) as client:
        told = await client.subscribe("plant/@gateway/demo/writes")
        await client.put("plant/mixer/trim/@set", b'{"value": -12}')
        done = await told.next(lambda s: s.json["key"] == "plant/mixer/trim")
        assert (done.json["outcome"], done.json["value"]) == ("written", -12)
        assert plant.plc.tell("get 1 D 501") == str(0x10000 - 12)
        told.forget()
        await client.put("plant/mixer/recipe/@set", b"99")
        refused = await told.next(lambda s: s.json["key"] == "plant/mixer/recipe")
        assert refused.json["outcome"] == "bad-value"


async def test_the_plc_holds_the_written_values(plant: Plant) -> None:
    """Reads the memory of the station, not the gateway."""
    async with ZenohPeer("client", connect=[plant.endpoint]) as client:
        for value in (7, 40, 1):
            [reply] = await client.get("plant/mixer/recipe/@set", str(value).encode())
            assert (reply.ok, reply.json["value"], reply.json["verified"]) == (True, value, True)
            assert plant.plc.tell("get 1 D 500") == str(value)
        for state in (b"true", b"false"):
            [reply] = await client.get("plant/mixer/run/@set", state)
            assert reply.ok
            assert plant.plc.tell("get 1 Y 16") == str(int(state == b"true"))


async def _writes(client: ZenohPeer) -> Any:
    """Returns the number of writes to the device; a status document is at most 0.2 s old."""
    [device] = await client.get("plant/@gateway/demo/devices/mixer")
    return device.json["writes"]
