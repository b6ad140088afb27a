"""Compares the samples of the gateway with the memory of the PLCs."""

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass, field

from gateway.plant.plant import Plant
from gateway.protocols.capabilities import UnnumberedReplies
from gateway.protocols.driver import Span
from gateway.protocols.frames import FrameDriver
from gateway.protocols.frames.driver import LISTENED
from gateway.tags import Quality, Reason, Sample, Tag
from tests.sim.bus import SPOKEN, Bus, summed
from tests.sim.foreign import Case
from tests.sim.gadgets import Gadget
from tests.sim.net import SimNet
from tests.sim.stations import Troubled
from tests.sim.story import Story
from tests.sim.wire import SimWire

LONGEST_STEP = 16  # addresses by which the gateway reads more, to change the shape
MOST_TROUBLES = 20  # recorded in one run


@dataclass(eq=False)
class Judge:
    """Judges every sample before the gateway gets it. Times by the loop's clock."""

    gateway: Plant
    buses: dict[str, Bus]  # by device
    stations: dict[str, Troubled]  # by device
    story: Story
    began: float
    read_at: dict[Tag, float] = field(default_factory=dict)  # when it was last good
    foreign_at: dict[Tag, float] = field(default_factory=dict)  # when a value was foreign
    online: dict[str, bool] = field(default_factory=dict)
    failures: set[tuple[float, str]] = field(default_factory=set)  # lines with internal errors

    def __post_init__(self) -> None:
        self._plain = self.gateway.samples
        self.gateway.samples = self.samples  # type: ignore[method-assign]  # the lines call it
        self.known = {tag for device in self.gateway.config.devices for tag in device.tags}
        self.enabled = {device.name for device in self.gateway.enabled_devices}

    def broke(self, what: str) -> None:
        if len(self.story.broken) < MOST_TROUBLES:
            self.story.broken.append(f"{self.now - self.began:.3f} s: {what}")

    @property
    def now(self) -> float:
        return asyncio.get_running_loop().time()

    # From the lines

    def samples(self, samples: Sequence[Sample]) -> None:
        for sample in samples:
            if sample.quality is Quality.GOOD:
                self._judge(sample)
            elif sample.reason is Reason.LINE_DOWN and "internal error" in sample.detail:
                self.failures.add((self.now, self.buses[sample.tag.device].config.name))
                self.story.counts["internal errors"] = len(self.failures)
                self.broke(f"{sample.tag.key}: {sample.detail}")
            elif "another station" in sample.detail and isinstance(
                self.buses[sample.tag.device].wire, SimNet
            ):
                self.broke(f"{sample.tag.key}: {sample.detail}")
        self._plain(samples)

    def published(self, samples: Sequence[Sample]) -> None:
        for sample in samples:
            if sample.tag not in self.known:
                self.broke(f"{sample.tag.key} is not configured, but published")
            if sample.quality is not Quality.GOOD:
                self.story.counts["bad samples"] += 1
                self.story.counts["overdue"] += sample.reason is Reason.OVERDUE

    def set_online(self, device: str, online: bool) -> None:
        self.online[device] = online
        if device not in self.enabled:
            self.broke(f"{device} is disabled, but reported as online or offline")

    def _judge(self, sample: Sample) -> None:
        tag, bus = sample.tag, self.buses[sample.tag.device]
        self.story.counts["good samples"] += 1
        self.read_at[tag] = self.now
        value = sample.value
        assert value is not None
        if tag.span.area == LISTENED:
            self._judge_unasked(sample, bus)
            return
        since = bus.asked_at(tag)
        self._judge_time(tag, bus, self.now - since)
        if self.stations[tag.device].was(tag, value, since, self.now):
            return
        if bus.blind(since):
            self._blind("blind reads", tag)
        elif tag.origin.shape is not None and (
            bus.untimely(tag.device) or bus.brought_older(since)
        ):
            self.story.counts["stale reads of frames"] += 1  # their frames name no request
        elif bus.foreign.took(bus.heard):
            self._took_foreign("foreign answers", tag, bus)
        elif bus.foreign.took_older(bus.heard, self._shapes(tag, bus), self.now):
            self._took_foreign("older answers", tag, bus)
        else:
            self.broke(
                f"{tag.key} is told as good {value!r}, which was not in the PLC since "
                f"{since - self.began:.3f}: heard {bus.heard!r}"
            )

    def _took_foreign(self, what: str, tag: Tag, bus: Bus) -> None:
        """One scan may be wrong before the gateway heard a reply to no request; none after it.

        No one can tell a second station with this number that replies alone.
        """
        self.story.counts[what] += 1
        self.foreign_at[tag] = self.now
        bus.foreign.evidence_at = bus.evidence_at
        foreign = bus.foreign
        if foreign.unknown_at >= bus.sent_at and foreign.is_alone(bus.own, bus.heard):
            self.story.counts["foreign answers alone"] += 1
            return
        case = bus.foreign.wrong_scan(self.now)
        if case is Case.SAME:
            return
        self.story.counts[case.value] += 1
        if case is not Case.FIRST:
            ago = self.now - max(bus.foreign.evidence_at, self.began)
            self.broke(f"{tag.key}: a foreign reply is a value, {case.value} ({ago:.1f} s)")

    def _shapes(self, tag: Tag, bus: Bus) -> int:
        """Counts the shapes of which the gateway can choose to read the tag: three at most."""
        device = next(d for d in bus.line.engine.devices if d.name == tag.device)
        block = next((block for block in device.blocks if tag in block.tags), None)
        driver, station = device.driver, self.stations[tag.device]
        if block is None or block.listed or not isinstance(driver, UnnumberedReplies):
            return 1
        area, start, size = block.span
        longer = [Span(area, start, size + n) for n in range(1, LONGEST_STEP + 1)]
        longer += [Span(area, start - n, size + n) for n in range(1, min(LONGEST_STEP, start) + 1)]
        there = [span for span in longer if driver.cost(span) and station.has(span)]
        return min(3, len({driver.reply_shape(span) for span in [block.span, *there]}))

    def _judge_time(self, tag: Tag, bus: Bus, took: float) -> None:
        """A reply that came after its time-out counts for nothing, also after a frozen loop."""
        device = next(d for d in bus.line.engine.devices if d.name == tag.device)
        serial = isinstance(bus.wire, SimWire)  # on TCP a reply has the number of its question
        spoken = [device.seconds(block.cost) for block in device.blocks if tag in block.tags]
        limit = device.timing.reply_timeout + max([SPOKEN, *spoken])
        if bus.proof:  # the loop may stand still between the reply and its proof
            limit += bus.proof + bus.stood_still(bus.proof)
        if serial and took > limit:
            self.broke(f"{tag.key} came after its time-out, {took:.2f} s after its question")

    def _judge_unasked(self, sample: Sample, bus: Bus) -> None:
        """The device sent the value just now, or while its own request was open."""
        station = self.stations[sample.tag.device].inner
        assert isinstance(station, Gadget)
        device = next(d for d in bus.line.engine.devices if d.name == sample.tag.device)
        since = self.now - 0.6 - device.timing.reply_timeout - device.settings.late_guard
        since -= bus.stood_still(0.1)  # its bytes waited
        if any(end >= since and value == sample.value for _, end, value in station.said):
            return
        if bus.hurt["<"] >= since - 0.5:
            self._blind("blind reads", sample.tag)
        elif bus.untimely(sample.tag.device) or bus.keeps_replies(sample.tag.device):
            self.story.counts["stale unsolicited frames"] += 1  # a held frame tells no time
        else:
            self.broke(f"{sample.tag.key} is told as good {sample.value!r}, which was not said")

    def _blind(self, what: str, tag: Tag) -> None:
        bus = self.buses[tag.device]
        device = next(d for d in bus.line.engine.devices if d.name == tag.device)
        self.story.counts[what if summed(device) else f"{what} without a sum"] += 1

    # Unsolicited frames

    def said(self, name: str, station: Gadget) -> None:
        """A weight is being sent: alone on a line without faults, it must become a sample."""
        bus = self.buses[name]
        start, end, value = station.said[-1]
        passed = start - self.began
        well = bus.line.engine.is_open and bus.line.engine.record.since < start - 2.0
        troubled = any(e.start < passed + 2.0 and e.end > passed - 5.0 for e in bus.episodes)
        if isinstance(bus.wire, SimWire):
            troubled = troubled or bus.wire.behind > start - 5.0 or bus.keeps_replies(name)
        if well and not troubled and not bus.collides:
            limit = end - start + station.wrapping.gap + 0.1
            asyncio.get_running_loop().call_later(limit, self._must_be_told, name, start, value)

    def _must_be_told(self, name: str, start: float, value: int) -> None:
        self.story.counts["words that must be told"] += 1
        (tag,) = (tag for tag in self.known if tag.device == name and tag.span.area == LISTENED)
        sample = self.gateway.mirror[tag]
        if (sample.value != value or self.read_at.get(tag, 0.0) < start) and (
            self.buses[name].hurt_at < start
        ):
            self.broke(f"{name} said {value} at {start - self.began:.3f}, and it was not told")

    def readable(self, tag: Tag) -> bool:
        """The tag can become good: it is polled, or sent by the device."""
        device = next(d for d in self.gateway.enabled_devices if d.name == tag.device)
        asked = device.driver.areas[tag.span.area].readable
        return asked or (isinstance(device.driver, FrameDriver) and tag.span.area == LISTENED)
