"""One device on a line: its settings, its plan, its health and its record."""

import math
from dataclasses import dataclass, field
from typing import Literal

from gateway.engine.health import Health, State, diagnosis
from gateway.engine.records import Record
from gateway.errors import LineDown
from gateway.planning.bad_addresses import BadAddresses
from gateway.planning.monitor_lists import with_monitor_list
from gateway.planning.planner import Block, plan
from gateway.planning.wire_timing import WireTiming
from gateway.protocols.driver import AnyDriver, Cost, NoReplyCauses, Span, Timing, Windowed
from gateway.tags import Tag

LEARN_EVERY = 50  # requests between two comparisons with the measured turnaround
MOST_PLANNED = 2000  # tags times intervals: planning them takes some tenths of a second
WORTH_WHILE = 0.1  # share of the wire time that a new plan must save
HALF_LIFE = 10.0  # seconds until past use of the wire counts half


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceSettings:
    """One station on a line, as the file describes it. Times in seconds."""

    name: str
    driver: AnyDriver
    timing: Timing  # the defaults of the protocol, with the settings of the file
    turnaround: float | None = None  # None: measured
    late_guard: float = 0.5  # the longest wait for a late reply after a time-out
    verify_reads: int = 1  # reads in a row that must agree
    blocks: bool | Literal["only"] = False  # one put per scan: also, or instead of one per tag
    control: bool = False  # run, stop, ... are allowed
    enabled: bool = True
    tags: tuple[Tag, ...] = ()


@dataclass(slots=True)
class Turnaround:
    """The turnaround of a station that plans and forecasts expect. Seconds."""

    configured: float | None
    expected: float | None = field(init=False)  # None: the default of the protocol
    look_at: float = LEARN_EVERY  # number of requests at the next comparison with the measured one
    _planned: float = 0.0  # the one in the last plan

    def __post_init__(self) -> None:
        self.expected = self.configured
        if self.configured is not None:
            self.look_at = math.inf

    def learn(self, record: Record) -> bool:
        """Expects the measured one from now on. Returns True if it differs enough to plan again."""
        if record.turnaround is None:
            return False
        self.look_at = record.exchanges + LEARN_EVERY
        self.expected = record.turnaround
        return abs(record.turnaround - self._planned) >= WORTH_WHILE * self._planned

    def planned(self) -> None:
        """Notes that the device was planned with the expected one."""
        self._planned = self.expected or 0.0


@dataclass(slots=True, eq=False)
class Device:
    """The state of one device; it belongs to one line."""

    settings: DeviceSettings
    wire: WireTiming
    health: Health = field(init=False)
    record: Record = field(default_factory=Record)
    bad_addresses: BadAddresses = field(init=False)
    turnaround: Turnaround = field(init=False)
    blocks: tuple[Block, ...] = ()
    registered: tuple[Span, ...] = ()  # the monitor list that the PLC holds, as far as known
    broadcast: bool = field(
        init=False
    )  # it receives writes or sends unsolicited frames, and never replies
    window: int = field(init=False)  # requests that may be outstanding at once
    silence: float = field(init=False)  # seconds before each request
    one_at_a_time: bool = False  # it loses requests that are sent together
    _lists: bool = True  # reads by a monitor list are allowed
    _use: tuple[float, float] = (0.0, 0.0)  # seconds of the wire, and the time of counting

    def __post_init__(self) -> None:
        driver = self.driver
        self.bad_addresses = BadAddresses(driver.cost)
        self.turnaround = Turnaround(self.settings.turnaround)
        used = [driver.areas[tag.span.area] for tag in self.tags] or driver.areas.values()
        self.broadcast = not any(area.readable for area in used)
        self.health = Health(answerable=not self.broadcast)
        self.window = driver.window if isinstance(driver, Windowed) else 1
        self.silence = self.wire.silence(self.timing)
        self.plan()

    @property
    def name(self) -> str:
        return self.settings.name

    @property
    def driver(self) -> AnyDriver:
        return self.settings.driver

    @property
    def timing(self) -> Timing:
        return self.settings.timing

    @property
    def tags(self) -> tuple[Tag, ...]:
        return self.settings.tags

    @property
    def state(self) -> State:
        return self.health.state

    @property
    def polled_tags(self) -> list[Tag]:
        """The tags that polls read."""
        return [tag for tag in self.tags if self.driver.areas[tag.span.area].readable]

    @property
    def longest_reply(self) -> float:
        """Seconds after a request until its reply can no longer arrive."""
        return self.timing.reply_timeout + self.settings.late_guard

    def diagnosis(self) -> str:
        """Returns the likely cause of its trouble as a sentence; empty when there is none."""
        driver = self.driver
        if self.one_at_a_time and self.health.trouble is None:
            return f"It takes one request at a time, not {self.window}: set `window: 1`"
        causes = driver.no_reply_causes if isinstance(driver, NoReplyCauses) else ""
        return diagnosis(self.health.trouble, causes)

    def takes_one_at_a_time(self, only: bool) -> None:
        """Notes if the device loses requests that are sent together."""
        self.one_at_a_time = only

    def restart(self, trouble: LineDown | None = None) -> None:
        """Starts again after the line was opened or lost."""
        self.health.restart(trouble)
        self.forget_list()

    # The plan

    def seconds(self, cost: Cost) -> float:
        """Returns the seconds of one transaction with this station."""
        return self.wire.transaction(cost, self.timing, self.turnaround.expected)

    @property
    def load(self) -> float:
        """The share of the wire time that its polls take."""
        once = sum(self.seconds(block.cost) / block.every for block in self.blocks)
        return once * self.settings.verify_reads

    def plan(self) -> None:
        """Plans the blocks that read the tags, without the bad addresses."""
        bad = self.bad_addresses
        blocks = plan(self.tags, self.driver, self.seconds, bad.cuts)
        if self._lists:
            blocks = with_monitor_list(blocks, self.driver, self.seconds, bad.bad.keys())
        self.blocks = blocks

    def poll_nothing(self) -> None:
        """Removes all polls: only requests of clients are sent."""
        self.blocks = ()

    def learn_turnaround(self) -> bool:
        """Plans again if the measured turnaround makes the load smaller. Returns True if it did.

        In both cases the measured one is expected from now on.
        """
        if self.record.exchanges < self.turnaround.look_at:
            return False
        if not self.turnaround.learn(self.record) or self._planning_takes_long:
            return False
        self.turnaround.planned()
        load, blocks = self.load, self.blocks
        self.plan()
        if self.load < (1 - WORTH_WHILE) * load:
            return True
        self.blocks = blocks
        return False

    @property
    def _planning_takes_long(self) -> bool:
        """True if a new plan would hold up all lines for too long."""
        return len(self.tags) * len({tag.every for tag in self.tags}) > MOST_PLANNED

    def interval(self, block: Block) -> float:
        """Returns the interval of the block; bad addresses are polled only rarely."""
        bad = self.bad_addresses.bad.get(block.span)
        return block.every if bad is None else max(bad.retry, block.every)

    # The monitor list in the PLC

    def expect_list(self, spans: tuple[Span, ...]) -> None:
        """Notes the list that is registered in the PLC next."""
        self.registered = spans

    def forget_list(self) -> None:
        """Forgets the list: the PLC may have restarted, or another master may have changed it."""
        self.registered = ()

    def allow_lists(self, allowed: bool) -> None:
        """Allows or forbids a monitor list: a PLC that refuses its list is read without one."""
        self._lists = allowed

    # Its share of the wire

    def used(self, now: float, begun: float) -> None:
        """Adds the time since `begun` of a poll or a probe.

        Writes and reads on demand do not count: the device must not lose polls because of them.
        """
        self._use = (self.recent_use(now) + now - begun, now)

    def recent_use(self, now: float) -> float:
        """Returns the seconds of polls and probes in about the last ten seconds."""
        use, when = self._use
        return use * math.exp2((when - now) / HALF_LIFE)
