"""A port is lost and comes back; the line recovers by itself."""

import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.conftest import needs
from tests.e2e.processes import (
    Program,
    cable,
    device_server,
    free_port,
    started,
    station,
    vigor_line,
    write_config,
)
from tests.zenoh_peer import Received, ZenohPeer, free_endpoint

TAGS = {
    "speed": {"address": "D10"},
    "door": {"address": "M12"},
    "recipe": {"address": "D500", "write": True},
}
KEYS = {f"plant/mixer/{name}" for name in TAGS}


class Link(NamedTuple):
    """A connection to the PLC that can be cut."""

    port: str
    plc: Program
    cut: Callable[[], object]
    mend: Callable[[], object]


def _cable(stack: ExitStack, folder: Path) -> Link:
    """Kills socat between two ptys: the pty is lost, and a new one appears at the same path."""
    socat = needs("socat")
    far, near = folder / "far", folder / "near"
    plc = stack.enter_context(station("pty", str(far)))

    def plug() -> Program:
        return stack.enter_context(cable(socat, near, f"file:{far},raw,echo=0"))

    plugged = plug()
    return Link(str(near), plc, lambda: plugged.end(signal.SIGKILL), plug)


def _tcp(stack: ExitStack, _folder: Path) -> Link:
    number = free_port()
    plc = stack.enter_context(station("tcp", str(number)))
    return Link(
        f"tcp://127.0.0.1:{number}", plc, lambda: plc.tell("deaf"), lambda: plc.tell("hear")
    )


def _rfc2217(stack: ExitStack, folder: Path) -> Link:
    ser2net = needs("ser2net")
    far, number = folder / "far", free_port()
    plc = stack.enter_context(station("pty", str(far)))

    def serve() -> Program:
        return stack.enter_context(device_server(ser2net, folder, far, number))

    server = serve()
    return Link(f"rfc2217://127.0.0.1:{number}", plc, lambda: server.end(signal.SIGKILL), serve)


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


@pytest.mark.parametrize("way", [_cable, _tcp, _rfc2217], ids=lambda way: way.__name__[1:])
async def test_the_line_recovers_by_itself(
    way: Callable[[ExitStack, Path], Link], stack: ExitStack, tmp_path: Path
) -> None:
    endpoint = free_endpoint()
    link = way(stack, tmp_path)
    link.plc.tell("count 1 D 10")
    line = vigor_line(link.port, TAGS)
    gateway = stack.enter_context(
        started(
            write_config(
                tmp_path / "config.yaml",
                endpoint,
                {"hall": line},
                defaults={"every": "200ms", "publish": "always"},
            )
        )
    )
    async with ZenohPeer("client", connect=[endpoint]) as client:
        alive = await client.liveliness("plant/@gateway/*/alive/mixer")
        heard = await client.subscribe("plant/mixer/*")
        await heard.until(lambda h: _all(h.latest(), "good"))

        link.cut()
        await heard.until(lambda h: _all(h.latest(), "bad"))
        assert {s.json["reason"] for s in heard.latest().values()} == {"line-down"}
        assert {s.json["value"] for s in heard.latest().values()} == {None}
        assert "why=" in gateway.says("line down", "line=hall")
        await alive.next(lambda t: t.kind == "DELETE")
        line = await client.get_until("plant/@gateway/demo/lines/hall", lambda one: one["trouble"])
        assert line["open"] is False
        [refused] = await client.get("plant/mixer/recipe/@set", b"9")
        assert not refused.ok
        assert refused.json["error"] == "line-down"

        alive.forget()
        link.mend()
        await heard.until(lambda h: _all(h.latest(), "good"))
        await alive.next(lambda t: t.kind == "PUT")
        assert link.plc.tell("get 1 D 500") == "0"
        [done] = await client.get("plant/mixer/recipe/@set", b"9")
        assert done.ok
        assert link.plc.tell("get 1 D 500") == "9"


def _all(latest: dict[str, Received], quality: str) -> bool:
    return latest.keys() == KEYS and all(s.json["quality"] == quality for s in latest.values())
