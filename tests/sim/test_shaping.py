"""Shaped values of a plant with faults, against the memory of its PLC: ten minutes, simulated."""

import asyncio
import struct
from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import partial
from itertools import pairwise
from pathlib import Path

import pytest

from gateway.config import load
from gateway.tags import Quality, Sample, Tag
from gateway.tags.mirror import Mirror
from gateway.values import Value
from tests.config.test_config import tags
from tests.sim.bench import WIRE
from tests.sim.plant import made_device, plant, running
from tests.sim.virtual import now, on_virtual_time

ROWS = (
    "level: {address: D1, from: [4000, 20000], to: [0, 100], decimals: 1, clamp: [0, 100]}",
    "mode: {address: D2, enum: {0: hand, 1: auto}}",
    "status: {address: D3, bits: {0: pump, 3: {name: fault, invert: true}}}",
    "high: {address: D3, type: uint8, byte: high}",
    "low: {address: D3, type: int8}",
    "flow: {address: D4, type: float32, scale: 0.1}",
    "door: {address: M5, debounce: 2s, invert: true}",
    "parts: {address: D8, type: uint16, counter: true}",
    'total: {computed: "flow * 2 + level"}',
    'share: {computed: "flow / (mode - 1)"}',
)
BEGIN, END = 1000, 1600  # seconds of the simulated clock
SLACK = 60  # ms between a request and its sample
STARTS_AGAIN = 1_300_000  # ms; the PLC was without power, and its counter begins at 0
POWER = ((1100, False), (1104, True), (1299.5, False), (1305, True), (END, False))  # mute until


def raw(address: int, ms: int) -> int:
    """The word of the PLC. Each motion keeps a value for at least 50 ms."""
    match address:
        case 1:
            return 3000 + ms // 50 * 7 % 19_000
        case 2:
            return ms // 7000 % 4
        case 3:
            return ms // 50 * 257 % 65_536
        case 8:
            count = ms // 100 * 40
            return (count if ms < STARTS_AGAIN else count - STARTS_AGAIN // 100 * 40) % 65_536
    halves = struct.unpack(">2H", struct.pack(">f", 2353 + ms // 1000 % 50))
    return int(halves[5 - address])


def word(address: int, seconds: float) -> int:
    return raw(address, int(seconds * 1000))


def shut(ms: int) -> bool:
    """The contact of the door: it bounces for 300 ms every 10 s, and changes every minute."""
    return bool(ms // 60_000 % 2) != (ms % 10_000 < 300)


EXPECTED: dict[str, Callable[[int], Value]] = {
    "level": lambda ms: min(100.0, max(0.0, round((raw(1, ms) - 4000) * 100 / 16_000, 1))),
    "mode": lambda ms: raw(2, ms),
    "status/pump": lambda ms: bool(raw(3, ms) & 1),
    "status/fault": lambda ms: not raw(3, ms) & 8,
    "high": lambda ms: raw(3, ms) >> 8,
    "low": lambda ms: (raw(3, ms) & 0x7F) - (raw(3, ms) & 0x80),
    "flow": lambda ms: float(Fraction(2353 + ms // 1000 % 50) / 10),
}


class Judge:
    """Compares what would be published with the memory of the PLC and among itself."""

    def __init__(self, known: Sequence[Tag]) -> None:
        self.tags = {tag.name: tag for tag in known}
        self.mirror = Mirror(known, 0)
        self.failure: AssertionError | None = None
        self.changes: dict[str, list[Sample]] = {tag.name: [] for tag in known}

    def samples(self, samples: Sequence[Sample]) -> None:
        """Keeps the first failure: the line would catch it."""
        try:
            self._judge(samples)
        except AssertionError as error:
            self.failure = self.failure or error

    def _judge(self, samples: Sequence[Sample]) -> None:
        published = self.mirror.update(samples)
        for sample in self.mirror.follow(published):
            assert sample.tag in self.tags.values(), "a raw read is published"
            self.changes[sample.tag.name].append(sample)
            if sample.quality is Quality.GOOD and (motion := EXPECTED.get(sample.tag.name)):
                at = sample.time // 1_000_000
                held = {motion(ms) for ms in range(at - SLACK, at + 1, 10)}
                assert sample.value in held, (sample.tag.name, at, sample.value, held)
        self._check_computed()

    def _check_computed(self) -> None:
        shown = {name: self.mirror[tag] for name, tag in self.tags.items()}
        flow, level, mode = (shown[name].value for name in ("flow", "level", "mode"))
        if None in (flow, level, mode):
            assert shown["share"].quality is Quality.BAD
            return
        assert isinstance(flow, float)
        total, share = shown["total"].value, shown["share"].value
        assert total == float(Fraction(str(flow)) * 2 + Fraction(str(level)))
        assert shown["total"].time == max(shown["flow"].time, shown["level"].time)
        if mode == 1:
            assert shown["share"].detail == "division by zero"
        else:
            assert share == pytest.approx(flow / (int(str(mode)) - 1), rel=1e-15)

    def steps(self, name: str) -> list[tuple[Sample, Sample]]:
        """Each two good samples in a row that were published."""
        good = [sample for sample in self.changes[name] if sample.quality is Quality.GOOD]
        return list(pairwise(good))


@on_virtual_time
async def test_every_setting_holds_on_a_line_with_faults(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    rule = "    defaults: {every: 250ms}\n    devices:\n"
    text = tags(*ROWS).replace("    devices:\n", rule, 1)
    Path("plant.yaml").write_text(text, encoding="utf-8")
    [settings] = load("plant.yaml").devices
    device = made_device("mixer", settings.driver, WIRE, settings.timing, settings.tags)
    world, judge = plant([device], seed=3), Judge(settings.tags)
    world.listeners.append(judge.samples)
    station = world.stations[0]
    for address in (1, 2, 3, 4, 5, 8):
        station.memory.animate("D", address, partial(word, address))
    station.memory.animate("M", 5, lambda now: shut(int(now * 1000)))
    station.lose, station.cut = 0.005, 0.003
    async with running(world):
        for until, mute in POWER:
            station.mute = mute
            await asyncio.sleep(until - now())

    if judge.failure is not None:
        raise judge.failure
    assert all(changes for changes in judge.changes.values())
    assert station.lost > 5
    turned_bad = [s.time for s in judge.changes["parts"] if s.quality is Quality.BAD]
    assert len(turned_bad) > 2
    for before, after in judge.steps("parts"):
        counted = int(str(after.value)) - int(str(before.value))
        assert 0 <= counted <= (after.time - before.time) // 1_000_000 * 0.4 + 80
    first, last = (int(str(judge.changes["parts"][place].value)) for place in (1, -1))
    all_counts = 400 * (END - BEGIN)
    assert all_counts - 3500 < last - first <= all_counts  # but those while it had no power
    opened = 0
    turned_bad = [s.time for s in judge.changes["door"] if s.quality is Quality.BAD]
    for before, after in judge.steps("door"):
        if before.value == after.value or any(0 < after.time - t < 3e9 for t in turned_bad):
            continue
        opened += 1
        assert after.value is not bool((after.time // 1_000_000 - 2300) // 60_000 % 2)
    assert opened >= 7
