"""Replay of a recording, and the line that only listens: the same values, and no byte sent."""

import asyncio
from dataclasses import replace
from functools import partial
from pathlib import Path

from gateway.config import Config, LineConfig, load
from gateway.line.exchanges import samples_of
from gateway.line.wire_log import Event, Performed, Piece
from gateway.parts.recording.replay import Checked, Difference, Learned, Replay
from gateway.parts.recording.wire_file import LoggedPiece, LoggedValue
from gateway.plant.build import line_of
from gateway.plant.plant import Plant
from gateway.transport import Port, Receiver
from tests.sim.virtual import on_virtual_time
from tests.writing import write

EXAMPLE = Path(__file__).parents[2] / "config.example.yaml"
Log = list[LoggedPiece | LoggedValue]


async def recorded(config: Config, seconds: float) -> dict[str, Log]:
    """Runs the gateway on simulated PLCs. Returns the wire log of each line."""
    gateway, loop = Plant(config), asyncio.get_running_loop()
    logs: dict[str, Log] = {name: [] for name in gateway.wire_logs()}

    def listener(log: Log, event: Event) -> None:
        if isinstance(event, Piece):
            log.append(LoggedPiece(loop.time(), event.way, event.data))
        elif isinstance(event, Performed):
            values = ((one.tag.key, one.value) for one in samples_of(event))
            log += [LoggedValue(loop.time(), *value) for value in values]

    for name, wire_log in gateway.wire_logs().items():
        wire_log.listen(partial(listener, logs[name]))
    lines = [asyncio.create_task(line.run()) for line in gateway.lines]
    await asyncio.sleep(seconds)
    recipe = gateway.tag("mixer/recipe")
    assert recipe is not None
    await write(gateway, recipe, 7)
    await asyncio.sleep(seconds)
    for line in lines:
        line.cancel()
    await asyncio.gather(*lines, return_exceptions=True)
    return logs


@on_virtual_time
async def test_a_recording_tells_the_values_of_the_live_run() -> None:
    """Vigor and Computer Link on one line, Modbus RTU in two dialects, Modbus TCP."""
    config = load(EXAMPLE)
    logs = await recorded(config, 10.0)
    for line in config.lines:
        replay, log = Replay(line), logs[line.name]
        learned = [one for one in replay.run(log) if isinstance(one, Learned)]
        values = sum(isinstance(entry, LoggedValue) for entry in log)
        assert values > 50
        # A reply that equals the one to the read before counts for nothing: the next one does.
        missing = replay.checked.missing
        assert replay.checked == Checked(equal=values - missing, missing=missing)
        assert missing <= values // 50
        known = {sample.tag.key for one in learned for sample in one.samples}
        assert known >= {entry.tag for entry in log if isinstance(entry, LoggedValue)}
    recipes = [
        entry.value
        for entry in logs["hall-1"]
        if isinstance(entry, LoggedValue) and entry.tag == "mixer/recipe"
    ]
    assert recipes[-1] == 7


@on_virtual_time
async def test_a_value_that_is_read_differently_now_is_reported() -> None:
    config = load(EXAMPLE)
    (log,) = (log for name, log in (await recorded(config, 2.0)).items() if name == "hall-2")
    (line,) = (line for line in config.lines if line.name == "hall-2")
    changed = [
        one._replace(value=-1) if isinstance(one, LoggedValue) and one.tag == "plc/count" else one
        for one in log
    ]
    replay = Replay(line)
    found = {one.logged.tag for one in replay.run(changed) if isinstance(one, Difference)}
    assert found == {"plc/count"}
    assert replay.checked.different > 1


class _Wire:
    """A port that notes what is written."""

    def __init__(self) -> None:
        self.written: list[bytes] = []

    def write(self, data: bytes) -> None:
        self.written.append(data)

    async def close(self) -> None:
        """Nothing is open."""


class _NoSink:
    def samples(self, samples: object) -> None: ...

    def online(self, device: object, online: bool) -> None: ...


async def written(line: LineConfig) -> list[bytes]:
    """Runs a line whose engine polls, on a port that notes what is written."""
    wire = _Wire()

    async def opened(_: Receiver) -> Port:
        return wire

    running = asyncio.create_task(line_of(line, line.devices, _NoSink(), open_port=opened).run())
    await asyncio.sleep(5.0)
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    return wire.written


@on_virtual_time
async def test_a_listen_only_line_sends_nothing_even_if_its_engine_would() -> None:
    polled = load(EXAMPLE).lines[0]
    assert await written(polled)
    assert await written(replace(polled, listen_only=True)) == []
