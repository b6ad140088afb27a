"""Checks the deadlines: values bad and good in time, every device polled, bounded queues."""

import asyncio
import math
from collections.abc import Mapping
from dataclasses import dataclass

from gateway.engine.device.device import PROOF_COST, Device
from gateway.engine.device.health import State
from gateway.engine.engine import Engine
from gateway.engine.jobs.unanswered import LONGEST_WAIT
from gateway.engine.results.unsolicited import UnsolicitedFrames
from gateway.line.line import Line
from gateway.line.polling import DIFFER
from gateway.planning.bad_addresses import RETRIES
from gateway.protocols.frames import FrameDriver
from gateway.protocols.frames.driver import LISTENED
from gateway.tags import Quality, Reason, Tag
from tests.sim.bus import UNTIMELY, Bus, summed
from tests.sim.episodes import CALM, Episode
from tests.sim.judge import Judge
from tests.sim.manners import SILENT
from tests.sim.net import SimNet
from tests.sim.stations import Troubled
from tests.sim.wire import SimWire

SPOKEN = 0.35  # seconds: the longest request and reply of a seed
LONGEST_PAUSE = 66.0  # between two probes of a silent device
DISTURBING = ("late", *UNTIMELY)  # late replies to probes may hit other requests
UNTRIED = RETRIES[-1] + 60.0  # seconds for which a refused address is not polled


@dataclass(eq=False)
class Expectations:
    """Times in seconds; episodes count from the start, all else by the loop's clock."""

    judge: Judge
    lines: Mapping[str, Bus]  # by line
    seconds: float  # of the whole run
    most_timers: int

    @property
    def passed(self) -> float:
        return self.judge.now - self.judge.began

    def later(self, limit: float, must: str, *what: object) -> None:
        asyncio.get_running_loop().call_later(limit, getattr(self, must), *what)

    def times(self, line: Line) -> tuple[float, float]:
        """Returns the longest duration of a failed transaction, and the line's load."""
        longest = (
            max(d.timing.reply_timeout + d.settings.late_guard for d in line.engine.devices)
            + SPOKEN
        )
        load = sum(d.load for d in line.engine.devices)
        for device in line.engine.devices:  # each read is proven, some by silence
            if device.is_doubtful:
                proof = device.seconds(PROOF_COST) + device.settled_after + device.longest_reply
                load += sum(proof / block.every for block in device.blocks)
        return longest, max(1.0, load)

    def every(self, bus: Bus, device: Device, tag: Tag) -> float:
        """Returns the seconds between two samples of the tag."""
        if tag.span.area == LISTENED and isinstance(device.driver, FrameDriver):
            listened = device.driver.settings.listen.values()
            (stale,) = {one.stale_after for one in listened if one.stale_after is not None}
            return stale / 10  # as it was drawn
        return tag.every

    def concerned(self, episode: Episode) -> list[tuple[Device, Tag]]:
        """Returns the tags that the episode concerns, without those that are never good."""
        return [
            (device, tag)
            for device in self.lines[episode.line].line.engine.devices
            if episode.device in ("", device.name)
            for tag in device.tags
            if episode.tag in ("", tag.name) and self.judge.readable(tag)
        ]

    # Bad in time

    def bad(self, episode: Episode) -> None:
        bus = self.lines[episode.line]
        gone = episode.kind == "gone"
        if not (episode.silent or gone) or self._mixed(episode) or not bus.line.engine.devices:
            return
        longest, load = self.times(bus.line)
        for device, tag in self.concerned(episode):
            every = self.every(bus, device, tag)
            limit = 2 * load * every + 2 * (len(bus.line.engine.devices) + 2) * longest + 1.0
            if tag.span.area == LISTENED:
                if episode.kind in ("stall", "held-requests", "reset"):
                    continue  # unsolicited frames continue
                limit = 10 * every + 2 * longest + 1.0
            if isinstance(bus.wire, SimNet) and any(
                (other.device or (other.kind == "hung" and len(bus.line.engine.devices) > 1))
                and other.device != device.name
                and other.start < episode.start + limit
                and episode.start < other.end + LONGEST_WAIT
                for other in bus.episodes
            ):
                limit += LONGEST_WAIT  # a request to that device may hold this one up, in a bridge
            if gone:  # refused twice, then found by halving
                limit += 3 * load * every + 8 * longest
                if self._unwell(episode.line, device.name, episode.start - LONGEST_PAUSE, limit):
                    continue
            if episode.start + limit < episode.end:
                self.later(limit, "_must_be_bad", tag, episode)

    def _mixed(self, episode: Episode) -> bool:
        """The line has another fault at that time."""
        return any(
            other is not episode
            and (not other.device or other.kind == "twin")
            and other.start < episode.end
            and other.end + 100 > episode.start
            for other in self.lines[episode.line].episodes
        )

    def _must_be_bad(self, tag: Tag, episode: Episode) -> None:
        if episode.kind == "hung" and not self.lines[episode.line].wire.hung:
            return  # the connection was opened again meanwhile
        gone = episode.kind == "gone"
        self.judge.story.counts["absence checks" if gone else "silence checks"] += 1
        if self.judge.gateway.mirror[tag].quality is Quality.GOOD:
            self.judge.broke(
                f"{tag.key} is still good, {self.passed - episode.start:.1f} s after "
                f"{episode.device or episode.line} became silent ({episode.kind})"
            )

    # Good again in time

    def good(self, episode: Episode) -> None:
        bus = self.lines[episode.line]
        if not bus.line.engine.devices or episode.end >= self.seconds:
            return
        longest, load = self.times(bus.line)
        for device, tag in self.concerned(episode):
            every = self.every(bus, device, tag)
            limit = (
                LONGEST_PAUSE + 20 * longest * len(bus.line.engine.devices) + 2 * load * every + 5.0
            )
            if tag.span.area == LISTENED:
                limit += 20 * every  # some of its frames cannot be parsed
            if episode.kind == "gone" or not summed(device):
                limit += UNTRIED  # damage may have changed a request, which was refused twice
            until = episode.end + limit
            troubled = any(
                other is not episode
                and (other.device in ("", device.name) or _disturbs(bus, other))
                and (other.kind == "gone" or other.tag in ("", tag.name))  # they may overlap
                and other.start < until
                and other.end > episode.end - LONGEST_PAUSE - UNTRIED * (other.kind == "gone")
                for other in bus.episodes
            )
            if not troubled and until < self.seconds:
                self.later(limit, "_must_be_good", tag, limit, episode)

    def _must_be_good(self, tag: Tag, limit: float, episode: Episode) -> None:
        judge, station = self.judge, self.judge.stations[tag.device]
        judge.story.counts["recovery checks"] += 1
        sample = judge.gateway.mirror[tag]
        if (sample.quality is Quality.GOOD) is not station.lacks(tag):
            return
        behind = _behind(self.judge.buses[tag.device]) > judge.now - LONGEST_PAUSE
        if not station.lacks(tag) and (behind or self._flaps(tag)):
            return
        if not station.lacks(tag) and self._passing(tag, judge.began + episode.end):
            return
        if sample.reason is Reason.OVERDUE and self.times(self.judge.buses[tag.device].line)[1] > 1:
            return
        judge.broke(
            f"{tag.key} is {sample.quality.value} ({sample.reason}: {sample.detail}) "
            f"{limit:.0f} s after {episode.kind} of {episode.device or episode.line} ended"
        )

    def _flaps(self, tag: Tag) -> bool:
        """Returns True for a Vigor station that may be silent to resyncs: they read M0 too."""
        station = self.judge.stations[tag.device]
        return station.protocol == "vigor" and station.manners.unknown == SILENT

    def _passing(self, tag: Tag, since: float) -> bool:
        """Unsolicited frames collide with replies: some are lost and come again.

        On a line without idle time most of them are lost. One that arrived after `since`, the end
        of the faults, shows that the gateway hears the device.
        """
        if self.judge.gateway.mirror[tag].detail == DIFFER:  # read, but it changes too fast
            return True
        bus = self.judge.buses[tag.device]
        read_at, said = self.judge.read_at.get(tag, 0.0), tag.span.area == LISTENED
        if bus.collides and said and self.times(bus.line)[1] > 1:
            return read_at > since
        return (bus.collides or said) and self.judge.now - read_at < LONGEST_PAUSE

    # During the run

    async def look_around(self) -> None:
        """Checks every minute that queues are bounded and that sound devices are polled."""
        gateway, judge = self.judge.gateway, self.judge
        while True:
            for _ in range(6):
                await asyncio.sleep(10.0)
                self._look_at_ages()
            for line in gateway.lines:
                self._look_at_queues(line.engine)
            # Private: a leak shows in no public figure.
            waiting = sum(map(len, gateway._on_demand.waiting.values()))
            if waiting > 2 * len(judge.enabled):
                judge.broke(f"{waiting} clients that asked for fresh values are still remembered")
            timers = len(asyncio.get_running_loop()._scheduled)  # type: ignore[attr-defined]
            if timers > self.most_timers:
                judge.broke(f"{timers} timers are waiting")
            judge.story.counts["most timers"] = max(judge.story.counts["most timers"], timers)
            for bus in self.lines.values():
                self._look_at_shares(bus)

    def _look_at_queues(self, engine: Engine) -> None:
        """Private attributes are read here: a leak shows in no public figure."""
        schedule, name, broke = engine.schedule, engine.name, self.judge.broke
        polls = sum(len(schedule.polls(device)) for device in engine.devices)
        kept = schedule._queue.entries
        if kept > 5 * polls + 50:  # twice as many in two heaps, and the expedited polls
            broke(f"{name}: {kept} entries in the queues for {polls} polls")
        requests = len(schedule.requests.waiting)
        groups = self.judge.story.pace == "groups"  # of all tags of each device
        if requests > sum(len(device.tags) if groups else 4 for device in engine.devices):
            broke(f"{name}: {requests} requests wait")
        for frames in engine.rules.all:
            if isinstance(frames, UnsolicitedFrames) and (replies := len(frames._replies)) > 4:
                broke(f"{name}: {replies} replies wait")

    def _look_at_ages(self) -> None:
        """No good value is older than a bound, which is above that of the gateway."""
        judge = self.judge
        for bus in self.lines.values():
            devices = bus.line.engine.devices
            if not devices or bus.stood_still(10.0):
                continue
            longest, _ = self.times(bus.line)
            one_round = sum(
                d.settings.verify_reads * d.seconds(b.cost) for d in devices for b in d.blocks
            )
            # While another unit is silent, the gateway waits so long for a reply: a bridge may be
            # waiting for that unit. A reply that comes again with an old number looks like a late
            # one, so also without a bridge.
            bridged = isinstance(bus.wire, SimNet) and len(devices) > 1
            behind_bridge = LONGEST_WAIT if bridged else 0.0
            for device in devices:
                for tag in device.polled_tags:
                    if judge.gateway.mirror[tag].quality is not Quality.GOOD:
                        continue
                    limit = 2 * (2 * tag.every + (len(devices) + 1) * one_round) + 2 * longest
                    limit += behind_bridge
                    age = judge.now - judge.read_at[tag]
                    judge.story.counts["looks at ages"] += 1
                    if age > limit:
                        judge.broke(f"{tag.key} is still good after {age:.1f} s unread")

    def _look_at_shares(self, bus: Bus) -> None:
        """A device without faults for two minutes, on such a line, is polled."""
        if not bus.line.engine.devices:
            return
        longest, load = self.times(bus.line)
        behind = _behind(bus)
        for device in bus.line.engine.devices:
            for tag in device.tags:
                station = self.judge.stations.get(device.name)
                if station is None or station.lacks(tag) or not self.judge.readable(tag):
                    continue
                patience = self._patience(bus, device, tag, station)
                since = self.judge.read_at.get(tag, 0.0)
                if self.judge.now - since <= patience or behind > since:
                    continue
                begin = self.passed - patience - LONGEST_PAUSE - 25 * longest - 60
                if not summed(device):
                    begin -= UNTRIED
                if begin < 0 or self._unwell(bus.line.engine.name, device.name, begin, 0.0):
                    continue
                if station.changed(tag, self.judge.now - patience - UNTRIED):
                    continue
                self.judge.story.counts["starved"] += 1
                self.judge.broke(
                    f"{tag.key} was not read for {self.judge.now - since:.1f} s, "
                    f"every {self.every(bus, device, tag):g} s is asked for, load {load:.2f}"
                )

    def _patience(self, bus: Bus, device: Device, tag: Tag, station: Troubled) -> float:
        """Returns the seconds within which a tag is read, without faults."""
        longest, load = self.times(bus.line)
        every = self.every(bus, device, tag)
        patience = 4 * load * every + 6 * longest * len(bus.line.engine.devices)
        if bus.collides or tag.span.area == LISTENED:
            patience += 20 * every + LONGEST_PAUSE
        if bus.collides and tag.span.area == LISTENED:
            # Without a header a frame counts after 50 ms of silence, which a busy line rarely has.
            patience += 180 * every
        if station.manners.unknown == SILENT:  # its blocks are halved by time-outs
            if device.driver.protocol == "vigor":
                return math.inf  # it flaps
            patience *= 3
        return patience

    def _unwell(self, line: str, device: str, since: float, ahead: float) -> bool:
        return any(
            (e.device in ("", device) or _disturbs(self.lines[line], e))
            and e.kind != "gone"
            and e.end > since
            and e.start < self.passed + ahead
            for e in self.lines[line].episodes
        )

    # At the end

    def at_the_end(self) -> None:
        """Checks the end of the run, after a time without faults."""
        if self.seconds < 2 * CALM:
            return
        judge = self.judge
        for bus in self.lines.values():
            if _behind(bus) > judge.now - LONGEST_PAUSE:
                continue
            for device in bus.line.engine.devices:
                well = device.state is State.ONLINE and judge.online.get(device.name)
                if not well and not device.broadcast and not bus.collides:
                    judge.broke(
                        f"{device.name} is {device.state.value} at the end: {device.health.trouble}"
                    )
                for tag in device.tags:
                    sample = judge.gateway.mirror[tag]
                    if not judge.readable(tag) or self._passing(tag, judge.now - CALM):
                        continue
                    if sample.reason is Reason.OVERDUE and self.times(bus.line)[1] > 1.0:
                        continue
                    lacks = judge.stations[device.name].lacks(tag)
                    if (sample.quality is Quality.GOOD) is lacks:
                        judge.broke(f"{tag.key} at the end: {sample}")


def _behind(bus: Bus) -> float:
    """When a server was behind: it delays every reply by more than a short reply_timeout."""
    return bus.wire.behind if isinstance(bus.wire, SimWire) else -math.inf


def _disturbs(bus: Bus, episode: Episode) -> bool:
    """The episode also concerns other devices of the line."""
    broken = episode.kind == "cut" and isinstance(bus.wire, SimNet)  # it cuts the connection too
    return broken or episode.kind in DISTURBING
