"""One device on a line as the gateway knows it: its plan, its standing, its record."""

import math
from collections import Counter, deque
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal

from gateway.errors import DeviceError, Evidence, Garbled, GatewayError, LineDown, NoReply
from gateway.planning.bad_addresses import RETRY, BadAddresses
from gateway.planning.monitor_lists import with_monitor_list
from gateway.planning.planner import Block, plan
from gateway.planning.wire_timing import WireTiming
from gateway.protocols.driver import AnyDriver, Cost, NoReplyCauses, Span, Timing, Windowed
from gateway.tags import Reason, Tag

LEARN_EVERY = 50  # exchanges between two looks at the measured turnaround
MOST_PLANNED = 2000  # tags times intervals, while lines run: some tenths of a second
WORTH_WHILE = 0.1  # of the wire's time, to be planned anew
MOST_UNANSWERED = 64  # questions whose time is kept
HALF_LIFE = 10.0  # seconds in which use of the wire is half forgotten


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


class Standing(StrEnum):
    """How far a device can be trusted to answer."""

    STARTING = "starting"  # not asked yet
    UP = "up"
    FAILING = "failing"  # its last conversation did not end well
    SILENT = "silent"  # left alone but for a probe now and then


@dataclass(slots=True)
class Record:
    """What has been counted since the start. Times in seconds."""

    exchanges: int = 0
    writes: int = 0
    wire_time: float = 0.0
    late: int = 0  # replies that came after the time-out
    unasked: int = 0  # frames that answered nothing
    heard: int = 0  # frames that came unasked and were understood
    overruns: int = 0  # polls left out because the one before was late
    overdue: int = 0  # blocks whose values turned bad because they were not read for too long
    failures: Counter[str] = field(default_factory=Counter)  # by evidence
    refusals: Counter[str] = field(default_factory=Counter)  # by the maker's code
    turnaround: float | None = None  # what the station takes, measured
    slowest_write: float = 0.0


@dataclass(slots=True)
class LineRecord:
    """What has been counted on a line since the start. Times in seconds."""

    opened: int = 0
    since: float = 0.0  # when it was opened last, by the loop's clock
    open_before: float = 0.0  # how long it was open the times before
    busy: float = 0.0  # characters on the wire, both ways
    turnarounds: float = 0.0  # waiting for stations that answered
    unasked: int = 0  # bytes that nobody had asked for
    trouble: str = ""  # why the port is not open

    def came_up(self, now: float) -> None:
        self.opened += 1
        self.since = now
        self.trouble = ""

    def went_down(self, trouble: str, served: float) -> None:
        self.trouble = trouble
        self.open_before += served


@dataclass(slots=True, eq=False)
class Device:
    """Settings, plan and state of one device; belongs to one line and to nobody else."""

    name: str
    driver: AnyDriver
    wire: WireTiming
    timing: Timing
    tags: tuple[Tag, ...]
    late_guard: float
    turnaround: float | None = None  # set in the file
    verify_reads: int = 1  # so many readings in a row must agree
    control: bool = False  # it may be told to run, stop ...
    blocks: tuple[Block, ...] = ()
    standing: Standing = Standing.STARTING
    failures: int = 0  # conversations in a row that ended unclear
    doubt: Span | None = None  # the question whose answer may still come
    doubtful: bool = True  # what is heard next may answer an older question
    unanswered: deque[float] = field(default_factory=lambda: deque(maxlen=MOST_UNANSWERED))
    salt: int = 0
    lists: bool = True  # whether it may be read by a registered list
    registered: tuple[Span, ...] = ()  # the list it holds, as far as we know
    pause: float = 0.0
    next_probe: float = 0.0
    trouble: GatewayError | None = None
    record: Record = field(default_factory=Record)
    _use: tuple[float, float] = (0.0, 0.0)  # seconds of the wire, and when that was reckoned
    refusals: BadAddresses = field(init=False)
    reckoned: float | None = field(init=False)  # the turnaround planned with; None: the usual
    _learn_at: int = LEARN_EVERY
    _tried: float = 0.0  # the turnaround that the last plan was tried with
    broadcast: bool = field(init=False)  # written or listened to, but never asked anything
    window: int = field(init=False)  # questions that may be open at once

    def __post_init__(self) -> None:
        self.refusals = BadAddresses(self.driver.cost)
        self.reckoned = self.turnaround
        areas = self.driver.areas
        used = [areas[tag.span.area] for tag in self.tags] or areas.values()
        self.broadcast = not any(area.readable for area in used)
        self.doubtful = not self.broadcast
        self.window = self.driver.window if isinstance(self.driver, Windowed) else 1
        self.plan()

    @property
    def asked(self) -> list[Tag]:
        """The tags whose values it is asked for."""
        return [tag for tag in self.tags if self.driver.areas[tag.span.area].readable]

    @property
    def served(self) -> bool:
        """It answers, as far as we know: its blocks are asked for."""
        return self.standing is Standing.UP or self.standing is Standing.FAILING

    def seconds(self, cost: Cost) -> float:
        """One exchange on this line with this station."""
        return self.wire.transaction(cost, self.timing, self.reckoned)

    @property
    def load(self) -> float:
        """The share of the line's time that its polls take."""
        once = sum(self.seconds(block.cost) / block.every for block in self.blocks)
        return once * self.verify_reads

    def plan(self) -> None:
        """Decide anew what to ask, around what the device has refused."""
        blocks = plan(self.tags, self.driver, self.seconds, self.refusals.cuts)
        if self.lists:
            blocks = with_monitor_list(blocks, self.driver, self.seconds, self.refusals.bad.keys())
        self.blocks = blocks

    def learn(self) -> bool:
        """Plan anew where the turnaround measured makes that worth while; True if it was done.

        In either case the measured one is reckoned with from now on.
        """
        measured = self.record.turnaround
        if self.turnaround is not None or measured is None:
            return False
        if self.record.exchanges < self._learn_at:
            return False
        self._learn_at = self.record.exchanges + LEARN_EVERY
        self.reckoned = measured
        if abs(measured - self._tried) < WORTH_WHILE * self._tried or self._takes_long:
            return False
        self._tried = measured
        now, blocks = self.load, self.blocks
        self.plan()
        if self.load < (1 - WORTH_WHILE) * now:
            return True
        self.blocks = blocks
        return False

    @property
    def _takes_long(self) -> bool:
        """To plan, while all lines wait."""
        return len(self.tags) * len({tag.every for tag in self.tags}) > MOST_PLANNED

    def interval(self, block: Block) -> float:
        """How often the block is asked: refused addresses only rarely."""
        bad = self.refusals.bad
        return max(RETRY, block.every) if bad and block.span in bad else block.every

    def start(self, trouble: LineDown | None = None) -> None:
        """The line was opened, or lost: who knows what is still on its way from before."""
        self.trouble = trouble
        self.standing = Standing.STARTING
        self.failures = 0
        self.doubtful = not self.broadcast
        self.registered = ()

    def answered(self) -> None:
        """A conversation ended well."""
        self.standing = Standing.UP
        self.failures = 0
        self.doubtful = False
        self.doubt = None
        self.trouble = None
        self.unanswered.clear()

    def failed(self, error: DeviceError, doubt: Span | None, now: float) -> None:
        """A conversation ended unclear; its answer may still be on the way.

        `doubt`: what was asked; None for a probe, which leaves an older doubt as it was.
        """
        self.failures += 1
        self.unanswered.append(now)
        self.registered = ()  # it may have been switched off
        if not (self._slow and isinstance(error, NoReply)):
            self.trouble = error  # who is known to be slow is not called dead: nobody waits for it
        self.doubtful = not self.broadcast
        if doubt is not None:
            self.doubt = doubt
        if self.standing is Standing.UP:
            self.standing = Standing.FAILING
        match error:
            case NoReply() | Garbled():
                self.record.failures[error.evidence] += 1
            case _:
                self.record.failures["other"] += 1

    def next_salt(self) -> int:
        """For a resync. The one after it stays free, for asking once more."""
        self.salt += 2
        return self.salt

    def open_questions(self, flowed: float) -> int:
        """How many may still be answered, where the line is known to have carried since."""
        since = flowed - self.patience
        return sum(asked > since for asked in self.unanswered)

    @property
    def patience(self) -> float:
        """How long an answer may take: seconds after which none comes any more."""
        return self.timing.reply_timeout + self.late_guard

    @property
    def _slow(self) -> bool:
        trouble = self.trouble
        return isinstance(trouble, Garbled) and trouble.evidence is Evidence.SLOW

    def used(self, now: float, begun: float) -> None:
        """It was polled in its turn, or probed, since `begun`.

        Writes do not count, nor what somebody wants to see now: they must not cost it its reads.
        """
        self._use = (self.recent_use(now) + now - begun, now)

    def recent_use(self, now: float) -> float:
        """Seconds it was polled and probed in about the last ten."""
        use, when = self._use
        return use * math.exp2((when - now) / HALF_LIFE)

    def conversed(self, exchanges: int, characters: float, turnarounds: float) -> None:
        """So many questions were answered; seconds of the wire, and of the station's own time."""
        self.record.wire_time += characters + turnarounds
        if exchanges:
            self.record.exchanges += exchanges
            self.measured(turnarounds / exchanges)

    def measured(self, turnaround: float) -> None:
        """A station's own time in one exchange, smoothed over about ten."""
        known = self.record.turnaround
        self.record.turnaround = turnaround if known is None else known + 0.1 * (turnaround - known)

    @property
    def reason(self) -> Reason:
        """Why its values are not known."""
        return Reason.GARBLED if isinstance(self.trouble, Garbled) else Reason.NO_REPLY

    def diagnosis(self) -> str:
        """What is the matter, in one sentence for people; empty when nothing is."""
        match self.trouble:
            case None:
                return ""
            case Garbled() as error:
                return f"{_ADVICE.get(error.evidence, 'not understood')} ({error})"
            case NoReply():
                driver = self.driver
                causes = driver.no_reply_causes if isinstance(driver, NoReplyCauses) else ""
                return f"{_SILENCE} {causes}".strip()
            case error:
                return str(error)


_SILENCE = (
    "No byte came back: check power, wiring (A and B), station number, baud rate and that no "
    "other master is on the line."
)
_ADVICE = {
    Evidence.ECHO: "Only our own request came back: the adapter echoes; set `echo: true`, "
    "and the station itself is silent",
    Evidence.NOISE: "Bytes came that are no frame: check baud rate, parity and data bits",
    Evidence.CHECKSUM: "Frames come with a wrong sum: noise, missing termination, or sum check "
    "set differently on both sides",
    Evidence.STATION: "Another station answered: check the station numbers",
    Evidence.SHAPE: "The answer was to some other question, or in another format",
    Evidence.SLOW: "It answers, but too late: raise reply_timeout",
    Evidence.TRUNCATED: "Answers break off: noise, or a device server that cuts packets",
}
