"""Clients that write, read fresh values and send commands, and check every outcome."""

import asyncio
import random
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from gateway.engine.device.device import Device
from gateway.errors import BadValue, Busy, GatewayError, LineDown, Offline, Refused
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.computer_link.replies import model_name
from gateway.protocols.frames.driver import LISTENED
from gateway.tags import Quality, Tag, WriteResult
from gateway.values import Kind, Value
from tests.sim.arrays import shown, value_of
from tests.sim.bus import Bus, summed
from tests.sim.hostile import DELAYING
from tests.sim.judge import Judge
from tests.sim.obeyed import (
    CLAIM,
    claimed,
    counts,
    most_requests,
    times,
    unsent_arrived,
    written_by_clients,
)
from tests.sim.stations import Troubled
from tests.sim.wire import SimWire
from tests.writing import write

MOST_WAITS = 60  # for a queue of requests
SOON = 1.0  # seconds within which an unacknowledged request arrives, if ever
NOT_SENT = (Busy, Offline, LineDown)
_QUIET = ("deaf", "reboot", "vanish", "flicker", "hung", *DELAYING)


class Asked(NamedTuple):
    """One write of a client: when, how many frames it took, what the PLC held before."""

    since: float
    sent: int
    beside_others: bool
    held: Value | None


@dataclass(eq=False)
class Client:
    """A client of one device. `rarity`: the factor by which its requests are rarer."""

    device: Device
    judge: Judge
    bus: Bus
    chance: random.Random
    rarity: float
    # Writes several tags in groups, in place of one by one.
    groups: Callable[["Client", list[tuple[Tag, Value]]], Awaitable[None]] | None = None

    @property
    def number(self) -> int:
        return self.bus.number_of(self.device)

    def mark(self) -> int:
        """Returns a mark for `sent`: the write frames to the device until now."""
        return self.bus.writes[self.number] - self.bus.carried[self.number]

    def sent(self, mark: int) -> int:
        """Counts the write frames since the mark, less those that transfers may have sent."""
        return max(0, self.bus.writes[self.number] - self.bus.carrying[self.number] - mark)

    def blind(self, what: str) -> None:
        count = what if summed(self.device) else f"{what} without a sum"
        self.judge.story.counts[count] += 1

    def deaf(self, device: str, since: float, kinds: tuple[str, ...] = _QUIET) -> bool:
        """The device may have missed what was sent after `since`."""
        begin = since - self.judge.began - 1.0
        now = self.judge.now - self.judge.began
        if isinstance(self.bus.wire, SimWire) and self.bus.wire.behind >= since - 1.0:
            return True
        return any(
            e.device in ("", device) and e.kind in kinds and e.start <= now and e.end >= begin
            for e in self.bus.episodes
        )

    async def _pause(self, mean: float) -> None:
        await asyncio.sleep(self.chance.expovariate(1 / (mean * self.rarity)))

    # Writes

    async def write_now_and_then(self) -> None:
        tags = written_by_clients(self.device.tags)
        number = self.chance.randrange(1000)
        pause = self.chance.choice((2.0, 10.0, 30.0, 120.0))
        while tags:
            await self._pause(pause)
            several = self.chance.choice((1, 1, 1, 1, 3))
            chosen = self.chance.sample(tags, min(several, len(tags)))
            writes = []
            for tag in chosen:
                number += 1
                if tag.layout.type.count:
                    value: Value = value_of(tag, number)
                elif tag.layout.type.kind is Kind.BOOL:
                    value = self.chance.random() < 0.5
                else:
                    bits = 32 if tag.span.size == 2 else 16
                    value = (number * 40_503) % (1 << bits)
                writes.append((tag, value))
            if self.groups is not None and not self.device.broadcast:
                await self.groups(self, writes)
            else:
                await self._write(writes)

    async def _write(self, writes: list[tuple[Tag, Value]]) -> None:
        """Writes several tags at once: in one frame, or one by one after a refusal."""
        mark, since, carried = self.mark(), self.judge.now, self.bus.carried[self.number]
        most = sum(most_requests(tag) for tag, _ in writes)
        if self.device.broadcast:
            await asyncio.gather(*(self._tell_all(tag, value) for tag, value in writes))
        else:
            await asyncio.gather(*(self._write_one(t, v, len(writes) > 1) for t, v in writes))
        sent = self.sent(mark)
        most += len(writes) > 1 or self.bus.carrying[self.number] > carried  # refused together
        if sent > most:
            self.judge.broke(f"{self.device.name}: {len(writes)} writes were sent {sent} times")
        if self.bus.hurt_at < since:
            self.judge.story.counts["writes in groups"] += len(writes) > 1

    async def _write_one(self, tag: Tag, value: Value, beside_others: bool) -> None:
        judge, bus, station = self.judge, self.bus, self.judge.stations[tag.device]
        mark, since = self.mark(), judge.now
        known = counts(station, tag)
        held = shown(tag, station.holds(tag))
        outcome = await self._outcome(tag, value)
        sent = self.sent(mark)
        bus.note("outcome", tag.key, value, type(outcome).__name__, sent)
        judge.story.counts[f"write {type(outcome).__name__}"] += 1
        obeyed = times(station, tag, known)
        asked = Asked(since, sent, beside_others, held)
        await self.judge_end(tag, value, outcome, asked, obeyed)

    async def judge_end(
        self,
        tag: Tag,
        value: Value,
        outcome: WriteResult | GatewayError,
        asked: Asked,
        obeyed: int,
    ) -> None:
        judge, bus, station = self.judge, self.bus, self.judge.stations[tag.device]
        since, sent, beside_others, held = asked
        now = shown(tag, station.holds(tag))
        holds = now == value
        most = 2 if tag.write is not None and tag.write.repeat else 1
        match outcome:
            case WriteResult(acknowledged=False):
                await self._must_arrive(tag, value, station, since)
                return
            case WriteResult():
                true = holds and (obeyed > 0 or held == value)
            case Refused() | BadValue():
                true = obeyed == 0
            case Busy() | Offline() | LineDown():
                true = obeyed == 0 and (sent == 0 or beside_others)
            case _:
                true = claimed(str(outcome), value) == claimed(str(outcome), now)
                judge.story.counts["parts of long writes"] += CLAIM in str(outcome)
                true = true and not unsent_arrived(station, tag, str(outcome), since)
        true = true and obeyed <= most
        if true:
            return
        done = isinstance(outcome, WriteResult)
        if bus.hurt_at >= since:
            self.blind("blind writes")
        elif obeyed and (holds or not done) and self.deaf(tag.device, since, DELAYING):
            judge.story.counts["older writes that a stalled link brought"] += 1
        elif bus.foreign.unknown_at >= since:
            judge.story.counts["foreign acknowledgements"] += 1
        elif tag.origin.shape is not None and (
            bus.untimely(tag.device) or self.deaf(tag.device, since - 30.0, DELAYING)
        ):
            judge.story.counts["stale acknowledgements of frames"] += 1
        else:
            judge.broke(
                f"{tag.key}: write of {value!r} ended {outcome!r}, sent {sent} times, "
                f"obeyed {obeyed} times, holds {holds}"
            )

    async def _outcome(self, tag: Tag, value: Value) -> WriteResult | GatewayError:
        try:
            return await write(self.judge.gateway, tag, value)
        except GatewayError as error:
            return error

    async def _must_arrive(self, tag: Tag, value: Value, station: Troubled, since: float) -> None:
        """Checks a write without an acknowledgement: without faults it arrives."""
        await asyncio.sleep(SOON)
        if self.deaf(tag.device, since) or self.bus.hurt_at >= since:
            return
        self.judge.story.counts["told writes checked"] += 1
        if shown(tag, station.holds(tag)) != value:
            self.judge.broke(f"{tag.key}: {value!r} was told, and is not there")

    async def _tell_all(self, tag: Tag, value: Value) -> None:
        judge, bus = self.judge, self.bus
        mark, since = self.mark(), judge.now
        outcome = await self._outcome(tag, value)
        sent = self.sent(mark)
        bus.note("told all", tag.key, value, type(outcome).__name__, sent)
        judge.story.counts[f"broadcast {type(outcome).__name__}"] += 1
        if isinstance(outcome, WriteResult) and outcome.acknowledged:
            judge.broke(
                f"{tag.key}: there is no acknowledgement, but the write is reported as done"
            )
        if not isinstance(outcome, WriteResult):
            return
        await asyncio.sleep(SOON)
        for _ in range(MOST_WAITS):  # a bridge passes on one request at a time
            if not (isinstance(bus.wire, SimWire) and bus.wire.server.backlog):
                break
            await asyncio.sleep(SOON)
        for name, station in bus.stations.items():
            if self.deaf(name, since) or bus.hurt_at >= since:
                continue
            judge.story.counts["told writes checked"] += 1
            history = station.written.get((tag.span.area, tag.span.start), [])
            if not any(at >= since for at, _ in history):
                judge.broke(f"{tag.key}: told to all, but {name} did not get it")

    # Fresh values

    async def ask_now_and_then(self) -> None:
        pause = self.chance.choice((5.0, 30.0, 300.0))
        tags = [tag for tag in self.device.tags if self.judge.readable(tag)]
        while tags:
            await self._pause(pause)
            await self._ask(self.chance.choice(tags), self.chance.choice((0.0, 0.5, 5.0, 60.0)))

    async def _ask(self, tag: Tag, most: float) -> None:
        judge, asked = self.judge, self.judge.now
        try:
            sample = await judge.gateway.fresh(tag, most)
        except Busy:
            judge.story.counts["fresh Busy"] += 1
            return
        self.bus.note("fresh", tag.key, sample.value)
        if sample.quality is not Quality.GOOD or sample.value is None:
            return
        judge.story.counts["fresh"] += 1
        if judge.read_at[tag] >= asked:
            return  # it was read since, and judged then
        if tag.span.area == LISTENED:
            return  # it cannot be polled
        since = asked - most - 1.5
        was = judge.stations[tag.device].was(tag, sample.value, since, judge.now)
        excused = self.bus.hurt_at >= since or self.bus.untimely(tag.device)
        excused = excused or judge.foreign_at.get(tag) == judge.read_at[tag]
        if not was and not excused and self.device.name not in self.bus.misled:
            judge.broke(f"{tag.key}: {sample.value!r} is not fresh within {most} s")

    # Commands

    async def command_now_and_then(self) -> None:
        pause = self.chance.choice((30.0, 120.0))
        while True:
            await self._pause(pause)
            name, argument = self.chance.choice(
                (
                    *(("run", ""), ("stop", ""), ("run", ""), ("model", "")),
                    *(("loopback", ""), ("loopback", "HALLO 1"), ("loopback", "no\x01")),
                    *(("global", "on"), ("global", "off"), ("global", "maybe")),
                )
            )
            await self._command(name, argument)

    async def _command(self, name: str, argument: str) -> None:
        judge, bus, station = self.judge, self.bus, self.judge.stations[self.device.name]
        number = 255 if name == "global" else self.number
        frames, since = bus.commands[number], judge.now
        ran, known = station.inner.link.running, _switched(station)  # type: ignore[attr-defined]
        outcome = await _said(lambda: judge.gateway.control(self.device.name, name, argument))
        sent = bus.commands[number] - frames
        bus.note("command", self.device.name, name, str(outcome), sent)
        judge.story.counts[f"command {name}"] += 1
        obeyed = _switched(station) - known
        runs = station.inner.link.running  # type: ignore[attr-defined]
        match name, outcome:
            case _, BadValue():  # another client may send `global` at the same time
                true = argument in ("no\x01", "maybe") and (sent == 0 or name == "global")
            case _, Busy() | Offline() | LineDown():
                true = sent == 0 or name == "global"  # as above
            case "run" | "stop", str():
                true = sent == 1 and obeyed == 1 and runs is (name == "run")
            case "run" | "stop", Refused():
                true = obeyed == 0 and (ran is (name == "run") or ran is runs)
            case "loopback", str():
                true = outcome == (argument or "ABCDE")
            case "model", str():
                true = outcome == model_name("9E")
            case "global", str():
                await self._must_be_known(argument, since)
                return
            case _:
                true = sent <= 1 and obeyed <= 1
        if true:
            return
        if bus.hurt_at >= since:
            self.blind("blind commands")
        else:
            judge.broke(
                f"{self.device.name}: {name} {argument!r} ended {outcome!r}, sent {sent} times, "
                f"obeyed {obeyed} times, runs {runs}"
            )

    async def _must_be_known(self, argument: str, since: float) -> None:
        """Checks a broadcast at every PLC of the line that hears it."""
        await asyncio.sleep(SOON)
        for name, station in self.bus.stations.items():
            device = next((d for d in self.bus.line.engine.devices if d.name == name), None)
            if device is None or not _alike(device, self.device):
                continue  # it has another format
            if self.deaf(name, since) or self.bus.hurt_at >= since:
                continue
            self.judge.story.counts["told commands checked"] += 1
            flag = station.written.get(("M8", 8126), [])
            if (int(argument == "on")) not in [value for at, value in flag if at >= since]:
                self.judge.broke(f"{name}: global {argument} did not arrive")


async def _said(ask: Callable[[], Awaitable[Any]]) -> Any:
    """Returns the reply, or the error."""
    try:
        return (await ask()).answer
    except GatewayError as error:
        return error


def _alike(one: Device, other: Device) -> bool:
    """Both drivers use the same frames."""
    match one.driver, other.driver:
        case ComputerLink() as a, ComputerLink() as b:
            return (a.frame_format, a.sum_check) == (b.frame_format, b.sum_check)
    return False


def _switched(station: Troubled) -> int:
    """Returns how often the PLC carried out run or stop."""
    return len(station.written.get(("M8", 8035), ()))
