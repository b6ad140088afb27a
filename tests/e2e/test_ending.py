"""The end of a gateway and the start of the next: signals, ports in use."""

import asyncio
import signal
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from tests.e2e.processes import (
    Program,
    gateway,
    plc_gateway,
    slowed,
    started,
    station,
    until,
    vigor_line,
    write_config,
)
from tests.zenoh_peer import ZenohPeer, free_endpoint

WITHIN = 2.0  # s: the contract's promise for SIGTERM and Ctrl-C


class Plant(NamedTuple):
    config: Path
    endpoint: str
    plc: Program


def _plant(folder: Path, tags: dict[str, Any], **device: Any) -> Iterator[Plant]:
    endpoint, tty = free_endpoint(), str(folder / "tty")
    config = write_config(
        folder / "config.yaml", endpoint, {"hall": vigor_line(tty, tags, **device)}
    )
    with station("pty", tty) as plc:
        plc.tell("count 1 D 10")
        yield Plant(config, endpoint, plc)


@pytest.fixture
def plant(tmp_path: Path) -> Iterator[Plant]:
    tags = {
        "speed": {"address": "D10", "publish": "always"},
        "recipe": {"address": "D500", "write": True},
    }
    yield from _plant(tmp_path, tags)


@pytest.fixture
def busy_plant(tmp_path: Path) -> Iterator[Plant]:
    """A line with far more requests than 19200 baud can carry: the wire is always busy."""
    tags: dict[str, dict[str, object]] = {
        f"d{i}": {"address": f"D{100 * i}", "every": "50ms"} for i in range(20)
    }
    tags["speed"] = {"address": "D10", "every": "50ms", "publish": "always"}
    tags |= {f"w{i}": {"address": f"D{3000 + i}", "write": True} for i in range(20)}
    yield from _plant(tmp_path, tags)


@pytest.mark.parametrize("by", [signal.SIGTERM, signal.SIGINT])
async def test_the_gateway_ends_in_time_under_load(busy_plant: Plant, by: signal.Signals) -> None:
    with started(busy_plant.config) as gateway:
        async with ZenohPeer("client", connect=[busy_plant.endpoint]) as client:
            alive = await client.liveliness("plant/@gateway/*/alive/**")
            heard = await client.subscribe("plant/**")
            await heard.next(lambda s: s.key == "plant/mixer/speed" and s.json["value"] is not None)
            writing = asyncio.create_task(
                client.many([(f"plant/mixer/w{i}/@set", b"%d" % (i + 1)) for i in range(20)])
            )
            await heard.next(lambda s: s.key == "plant/mixer/w0" and s.json["value"] == 1)
            seen = len(heard.samples)

            told, wall = time.monotonic(), time.time()
            code = await asyncio.to_thread(gateway.end, by)
            took = time.monotonic() - told
            assert code == 0
            assert took < slowed(WITHIN)
            assert not gateway.has_said("Traceback")

            # Every write has an outcome, and no outcome is wrong.
            for i, replies in enumerate(await writing):
                [reply] = replies
                held = int(busy_plant.plc.tell(f"get 1 D {3000 + i}"))
                if reply.ok:
                    assert held == i + 1
                elif reply.json["error"] != "unclear":
                    assert held == 0
            # What the last exchanges said went out; the tokens went with the gateway.
            await alive.until(lambda a: all(t.kind == "DELETE" for t in a.latest().values()))
            last = [s for s in heard.samples if s.key == "plant/mixer/speed"][-1]
            assert len(heard.samples) >= seen
            assert wall - _time(last.json) < slowed(1.0)


@pytest.fixture
def slow_plant(tmp_path: Path) -> Iterator[Plant]:
    """Its PLC may take 5 s to answer."""
    tags = {
        "recipe": {"address": "D500", "write": True, "every": "1h"},
        "other": {"address": "D501", "write": True, "every": "1h"},
    }
    yield from _plant(tmp_path, tags, reply_timeout="5s")


async def test_writes_in_flight_and_in_the_queue_get_a_reply(
    slow_plant: Plant,
) -> None:
    plc = slow_plant.plc
    with started(slow_plant.config) as gateway:
        async with ZenohPeer("client", connect=[slow_plant.endpoint]) as client:
            # Then nothing is polled for an hour.
            await client.get_until("plant/mixer/other", lambda one: one["quality"] == "good")
            plc.tell("delay 1 4")
            writing = asyncio.create_task(
                client.many([(f"plant/mixer/{tag}/@set", b"7") for tag in ("recipe", "other")])
            )

            def held() -> list[str]:
                return [plc.tell("get 1 D 500"), plc.tell("get 1 D 501")]

            await asyncio.to_thread(until, lambda: "7" in held(), "the PLC obeys")
            told = time.monotonic()
            assert await asyncio.to_thread(gateway.end) == 0
            assert time.monotonic() - told < slowed(WITHIN)
            # The PLC wrote one value and its reply was lost: unclear. The other was never sent.
            answers = zip(held(), await writing, strict=True)
            errors = {value: reply.json["error"] for value, [reply] in answers}
            assert errors == {"7": "unclear", "0": "line-down"}


def test_a_client_without_its_router_ends_in_time(tmp_path: Path) -> None:
    """It waits for the router and polls."""
    lines = {"hall": vigor_line("simulator", {"speed": {"address": "D10"}})}
    zenoh = {"mode": "client", "listen": [], "connect": [free_endpoint()]}
    path = write_config(tmp_path / "config.yaml", "", lines, zenoh=zenoh)
    with gateway("run", path) as program:
        program.says("device online")
        program.says("Zenoh router unreachable")
        told = time.monotonic()
        assert program.end() == 0
        assert time.monotonic() - told < slowed(WITHIN)
        assert not program.has_said("Traceback")


def test_a_client_of_mute_routers_ends_in_time(tmp_path: Path) -> None:
    """They take connections and say nothing: each holds the thread that opens for seconds."""
    lines = {"hall": vigor_line("simulator", {"speed": {"address": "D10"}})}
    with ExitStack() as mute:
        routers = [mute.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(2)]
        connect = [f"tcp/127.0.0.1:{router.getsockname()[1]}" for router in routers]
        zenoh = {"mode": "client", "listen": [], "connect": connect}
        path = write_config(tmp_path / "config.yaml", "", lines, zenoh=zenoh)
        with gateway("run", path) as program:
            program.says("device online")
            mute.enter_context(routers[0].accept()[0])
            told = time.monotonic()
            assert program.end() == 0
            assert time.monotonic() - told < slowed(WITHIN)
            assert not program.has_said("Traceback")


async def test_a_second_gateway_at_the_same_port_reports_it_and_waits(
    plant: Plant, tmp_path: Path
) -> None:
    endpoint = free_endpoint()
    tty = str(tmp_path / "tty")
    tags = {"speed": {"address": "D10"}}
    other = write_config(tmp_path / "other.yaml", endpoint, {"hall": vigor_line(tty, tags)})
    with started(plant.config) as first:
        first.says("device online")
        with gateway("run", other) as second:
            why = second.says("line down")
            assert f"{tty}: in use by another program" in why
            second.says("Zenoh session ready")
            async with ZenohPeer("client", connect=[endpoint]) as client:
                heard = await client.subscribe("plant/**")
                [value] = await client.get("plant/mixer/speed")
                assert (value.json["value"], value.json["reason"]) == (None, "line-down")
                line = await client.get_until(
                    "plant/@gateway/demo/lines/hall", lambda one: one["trouble"]
                )
                assert "in use by another program" in line["trouble"]
                assert not first.has_said("line down")

                direct = plc_gateway("read", plant.config, "mixer/speed", "--direct")
                assert direct.code == 1
                assert "leave out --direct" in direct.err

                first.end()
                await heard.next(lambda s: s.json["quality"] == "good")


def test_a_zenoh_port_in_use_is_reported_in_one_line(plant: Plant, tmp_path: Path) -> None:
    lines = {"hall": vigor_line("simulator", {"speed": {"address": "D10"}})}
    name = {"name": "other"}
    other = write_config(tmp_path / "other.yaml", plant.endpoint, lines, gateway=name)
    with started(plant.config):
        done = plc_gateway("run", other)
    assert done.code == 1
    said = [line for line in done.err.splitlines() if "Zenoh" in line]
    assert len(said) == 1
    assert plant.endpoint.removeprefix("tcp/") in said[0]


def _time(document: Any) -> float:
    return datetime.fromisoformat(document["time"]).timestamp()
