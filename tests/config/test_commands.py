"""Commands to PLCs over Zenoh and by hand: obeyed where the file allows it, else refused unsent."""

import asyncio
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from gateway.config import load
from gateway.config.commands import NotControlled, check_command, speaker
from gateway.contract.keys import Keys
from gateway.errors import BadValue, ConfigError, LineDown
from gateway.plant.plant import Plant
from tests.conftest import Command
from tests.e2e.processes import plc_gateway, started, write_config
from tests.zenoh_peer import ZenohPeer, free_endpoint

KEYS = Keys("plant", "demo")


def link(station: int, **settings: Any) -> dict[str, Any]:
    tags = {"speed": {"address": "D10"}}
    return {"protocol": "computer-link", "station": station, "tags": tags, **settings}


def lines(**devices: dict[str, Any]) -> dict[str, Any]:
    return {"hall": {"port": "simulator", "baudrate": 19200, "format": "7E1", "devices": devices}}


def written(folder: Path, endpoint: str = "tcp/127.0.0.1:7447", **devices: Any) -> Path:
    plant = devices or {
        "oven": link(5, control=True),
        "saw": link(6),
        "old": link(7, control=True, enabled=False),
        "vigor": {"protocol": "vigor", "station": 1, "control": True, "tags": {"a": "D1"}},
    }
    plant = {name: dict(device) for name, device in plant.items()}
    for device in plant.values():
        device["tags"] = {
            name: {"address": tag} if isinstance(tag, str) else tag
            for name, tag in device["tags"].items()
        }
    return write_config(folder / "config.yaml", endpoint, lines(**plant))


# What the file allows


@pytest.mark.parametrize(
    ("device", "command", "why"),
    [
        ("saw", "stop", "no `control: true`"),
        ("vigor", "stop", "takes no commands"),
        ("old", "stop", "disabled"),
        ("nobody", "stop", "no device nobody"),
        ("oven", "explode", "none of its commands"),
        ("oven", "global", "saw does not permit commands"),
    ],
)
def test_what_the_file_does_not_allow(tmp_path: Path, device: str, command: str, why: str) -> None:
    config = load(written(tmp_path))
    check_command(config, "oven", "stop")
    with pytest.raises(BadValue, match=why):
        check_command(config, device, command)


def test_all_stations_are_told_in_the_name_of_one_that_is_there(tmp_path: Path) -> None:
    config = load(written(tmp_path))
    assert speaker(config, "hall") == "oven"
    with pytest.raises(BadValue, match="no line attic"):
        speaker(config, "attic")
    both = load(written(tmp_path, oven=link(5, control=True), saw=link(6, control=True)))
    check_command(both, "saw", "global")


def test_area_c_on_an_echoing_line_is_an_error(tmp_path: Path) -> None:
    """An echoed acknowledgement of ours looks exactly like the PLC's to a write."""
    path = written(tmp_path, oven=link(5, send_area_c=True))
    load(path)
    path.write_text(path.read_text().replace('"baudrate"', '"echo": true, "baudrate"'))
    with pytest.raises(ConfigError, match=r"send_area_c.*echo"):
        load(path)
    path.write_text(path.read_text().replace('"send_area_c": true', '"send_area_c": false'))
    load(path)


async def test_the_gateway_hands_commands_to_the_line(tmp_path: Path) -> None:
    gateway = Plant(load(written(tmp_path)))
    with pytest.raises(LineDown):
        await gateway.control("oven", "model")
    tasks = [asyncio.create_task(line.run()) for line in gateway.lines]
    async with asyncio.timeout(300):
        while not gateway.lines[0].engine.is_open:
            await asyncio.sleep(0)
        said = await gateway.control("oven", "model")
        with pytest.raises(NotControlled):
            await gateway.control("saw", "stop")
    assert said.answer == "9E (FX1N)"
    assert said.took > 0
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


# Over Zenoh and by hand


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Path]]:
    endpoint = free_endpoint()
    path = written(tmp_path_factory.mktemp("controls"), endpoint)
    with ExitStack() as stack:
        stack.enter_context(started(path))
        yield endpoint, path


async def test_over_zenoh(served: tuple[str, Path]) -> None:
    async with ZenohPeer("client", connect=[served[0]]) as client:
        [model] = await client.get("plant/oven/@model")
        assert model.ok
        assert model.json.keys() == {"answer", "time", "took"}
        assert model.json["answer"] == "9E (FX1N)"
        for key, error in (
            ("plant/saw/@stop", "not-writable"),
            ("plant/*/@stop", "bad-value"),
            ("plant/@gateway/demo/lines/hall/global", "not-writable"),
            ("plant/@gateway/demo/lines/attic/global", "bad-value"),
        ):
            for refused in await client.get(key, b""):
                assert not refused.ok
                assert refused.json.keys() == {"error", "code", "reason"}
                assert refused.json["error"] == error
        [running] = await client.get("plant/oven/@run")
        assert (running.json["error"], running.json["code"]) == ("refused", "18")
        [none] = await client.get("plant/vigor/@stop")
        assert none.json["error"] == "bad-value"
        assert await client.get("plant/nobody/@stop") == []
        assert [reply.key for reply in await client.get("plant/**")]  # asks, and commands nothing
        audit = await client.subscribe("plant/@gateway/*/writes")
        [stopped] = await client.get("plant/oven/@stop")
        assert stopped.json["answer"] == "acknowledged"
        told = (await audit.next(lambda _: True)).json
        assert (told["key"], told["outcome"]) == ("plant/oven/@stop", "obeyed")


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (("oven", "model"), 0, "9E (FX1N)"),
        (("oven", "loopback", "AB CD"), 0, "AB CD"),
        (("saw", "stop"), 2, "control: true"),
        (("oven", "explode"), 2, "none of its commands"),
        (("nobody", "run"), 2, "no device nobody"),
        (("oven", "loopback", "Ä"), 2, "printable"),
        (("oven", "model", "--direct"), 1, "leave out --direct"),
    ],
)
def test_by_hand(
    command: Command, served: tuple[str, Path], arguments: tuple[str, ...], code: int, says: str
) -> None:
    done = command("control", served[1], *arguments)
    assert done.code == code, done
    assert says in (done.out if code == 0 else done.err)


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (("oven", "model"), 1, "no gateway"),
        (("oven", "model", "--direct"), 0, "9E (FX1N)"),
        (("oven", "run", "--direct"), 1, "NAK 18"),
        (("oven", "loopback", "Ä", "--direct"), 2, "printable"),
    ],
)
def test_by_hand_without_a_gateway(
    tmp_path: Path, arguments: tuple[str, ...], code: int, says: str
) -> None:
    done = plc_gateway("control", written(tmp_path, free_endpoint()), *arguments)
    assert done.code == code, done
    assert says in (done.out if code == 0 else done.err)
