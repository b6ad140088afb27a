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

LEARN_EVERY = 50  # exchanges between two looks at the measured turnaround
MOST_PLANNED = 2000  # tags times intervals, while lines run: some tenths of a second
WORTH_WHILE = 0.1  # of the wire's time, to plan again
HALF_LIFE = 10.0  # seconds in which half of the use of the wire is forgotten


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceSettings:
    """One station on a line, as the file describes it. Times in seconds."""

    name: str
    driver: AnyDriver
    timing: Timing  # the protocol's, with the file's own for this device
    turnaround: float | None = None  # None: measured
    late_guard: float = 0.5  # how long the line waits for a late reply before it goes on
    verify_reads: int = 1  # so many reads in a row must agree
    blocks: bool | Literal["only"] = False  # one put per scan: also, or instead of one per tag
    control: bool = False  # run, stop, ... are allowed
    enabled: bool = True
    tags: tuple[Tag, ...] = ()


@dataclass(slots=True)
class Turnaround:
    """What a station takes for a reply, as far as plans and forecasts count on it. Seconds."""

    configured: float | None
    expected: float | None = field(init=False)  # None: the protocol's usual
    look_at: float = LEARN_EVERY  # exchanges, until it is compared with the one measured
    _planned: float = 0.0  # with which the device was planned last

    def __post_init__(self) -> None:
        self.expected = self.configured
        if self.configured is not None:
            self.look_at = math.inf

    def learn(self, record: Record) -> bool:
        """Expect the measured one from now on. True when it moved enough to plan again."""
        if record.turnaround is None:
            return False
        self.look_at = record.exchanges + LEARN_EVERY
        self.expected = record.turnaround
        return abs(record.turnaround - self._planned) >= WORTH_WHILE * self._planned

    def planned(self) -> None:
        """The device is planned with the one expected now."""
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
    broadcast: bool = field(init=False)  # written or listened to, but never asked
    window: int = field(init=False)  # requests that may be open at once
    silence: float = field(init=False)  # seconds before each request
    _lists: bool = True  # it may be read by a monitor list
    _use: tuple[float, float] = (0.0, 0.0)  # seconds of the wire, and when they were counted

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
        """The tags that requests read."""
        return [tag for tag in self.tags if self.driver.areas[tag.span.area].readable]

    @property
    def longest_reply(self) -> float:
        """Seconds after a request when its reply can no longer arrive."""
        return self.timing.reply_timeout + self.settings.late_guard

    def diagnosis(self) -> str:
        """One sentence for people: why it does not answer as it should; empty when it does."""
        driver = self.driver
        causes = driver.no_reply_causes if isinstance(driver, NoReplyCauses) else ""
        return diagnosis(self.health.trouble, causes)

    def restart(self, trouble: LineDown | None = None) -> None:
        """The line was opened, or lost."""
        self.health.restart(trouble)
        self.forget_list()

    # The plan

    def seconds(self, cost: Cost) -> float:
        """One exchange on this line with this station."""
        return self.wire.transaction(cost, self.timing, self.turnaround.expected)

    @property
    def load(self) -> float:
        """The share of the line's time that its polls take."""
        once = sum(self.seconds(block.cost) / block.every for block in self.blocks)
        return once * self.settings.verify_reads

    def plan(self) -> None:
        """Decide which requests read the tags, around the addresses that the device refuses."""
        bad = self.bad_addresses
        blocks = plan(self.tags, self.driver, self.seconds, bad.cuts)
        if self._lists:
            blocks = with_monitor_list(blocks, self.driver, self.seconds, bad.bad.keys())
        self.blocks = blocks

    def poll_nothing(self) -> None:
        """Leave out all polls: only requests are sent."""
        self.blocks = ()

    def learn_turnaround(self) -> bool:
        """Plan again where the measured turnaround makes that worth while. True if it was done.

        In either case the measured one is expected from now on.
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
        """All lines wait while one is planned."""
        return len(self.tags) * len({tag.every for tag in self.tags}) > MOST_PLANNED

    def interval(self, block: Block) -> float:
        """How often the block is polled: bad addresses only rarely."""
        bad = self.bad_addresses.bad.get(block.span)
        return block.every if bad is None else max(bad.retry, block.every)

    # The monitor list in the PLC

    def expect_list(self, spans: tuple[Span, ...]) -> None:
        """The PLC is about to be given this list."""
        self.registered = spans

    def forget_list(self) -> None:
        """The PLC may have been switched off, or another master has spoken to it."""
        self.registered = ()

    def allow_lists(self, allowed: bool) -> None:
        """A PLC that refuses its list is read without one."""
        self._lists = allowed

    # Its share of the wire

    def used(self, now: float, begun: float) -> None:
        """It was polled or probed since `begun`.

        Writes do not count, nor reads on demand: they must not cost the device its polls.
        """
        self._use = (self.recent_use(now) + now - begun, now)

    def recent_use(self, now: float) -> float:
        """Seconds of polls and probes in about the last ten seconds."""
        use, when = self._use
        return use * math.exp2((when - now) / HALF_LIFE)
