"""The state of one device on a line: its plan, its health and its record."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import InitVar, dataclass, field

from gateway.engine.device.device_settings import DeviceSettings
from gateway.engine.device.health import Health, State, diagnosis
from gateway.engine.device.identity import Identity
from gateway.engine.device.monitor_list import MonitorList
from gateway.engine.device.records import Record, late_from
from gateway.engine.device.reply_shapes import MOST_HELD, GoodReads, ReplyShapes, reply_shapes
from gateway.engine.device.station_silence import StationSilence
from gateway.engine.device.turnaround import Turnaround
from gateway.errors import NO_TROUBLE, Diagnosis, Evidence, Garbled, LineDown, NoReply
from gateway.planning.bad_addresses import RETRIES, BadAddresses, KnownBad
from gateway.planning.monitor_lists import with_monitor_list
from gateway.planning.planner import Block, around, plan, requests_a_second, runs_of
from gateway.planning.wire_timing import Transactions, WireTiming
from gateway.protocols.capabilities import Monitor, Windowed
from gateway.protocols.driver import PROOF, AnyDriver, Cost, Span, Timing
from gateway.protocols.swapped import SWAPPED, KnownReplies, is_swapped
from gateway.tags import Tag

MOST_PLANNED = 1000  # tags times intervals: planning them takes some tenths of a second
PLANNING = 2e-4  # seconds for each tag and interval, estimated
SILENT_SHARE = 0.01  # share of the time for new tries of silent addresses
MOST_PROBED = 8  # places among which the resyncs change
WORTH_WHILE = 0.1  # share of the wire time that a new plan must save
ANSWERS_TWICE = (
    "Answers twice: a second master is on the line, two stations have the number {station}, or a "
    "device server repeats replies"
)
GIVES_WAY = (
    "A poll takes {slow:.2f} s, usual are {planned:.2f} s: it waits where others need the wire; "
    "set `turnaround`"
)
ECHO_PROVEN_FOR = 2.0  # seconds after which an adapter may echo that did not before
QUIET_MARGIN = 0.05  # seconds that a station may take longer than usual
PROOF_COST = Cost(20, 30)  # characters of a resync, about
HALF_LIFE = 10.0  # seconds until past use of the wire counts half


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
    good_reads: GoodReads = field(default_factory=GoodReads)
    monitor: MonitorList = field(default_factory=MonitorList)
    window: int = field(init=False)  # requests that may be outstanding at once
    silence: StationSilence = field(init=False)
    shapes: ReplyShapes | None = field(init=False)  # None: no reply, or each has a number
    identity: Identity | None = field(init=False)  # None: the file says nothing of it
    one_at_a_time: bool = False  # it loses requests that are sent together
    # Its recent use of the wire, to compare with that of other devices: the binary logarithm of
    # the seconds, plus the half-lives until the time of counting. It grows, and never decays.
    use: float = -math.inf
    plan_now: InitVar[bool] = True  # False: the owner calls `plan` before the line runs

    def __post_init__(self, plan_now: bool) -> None:
        driver = self.driver
        self.bad_addresses = BadAddresses(driver.cost)
        self.turnaround = Turnaround(self.settings.turnaround)
        answers = self.settings.answerable
        written = answers and bool(self.tags) and not any(tag.polled for tag in self.tags)
        self.health = Health(answerable=answers, only_written=written)
        self.identity = Identity(self.settings.identity) if self.settings.identity else None
        self.window = driver.window if isinstance(driver, Windowed) else 1
        self.shapes = (
            None if self.broadcast else reply_shapes(driver, self.polled_tags, self.bad_addresses)
        )
        safe = self.wire.silence(self.timing)
        learns = self.timing.learn_silence and self.shapes is not None
        self.silence = StationSilence(safe, min(safe, self.wire.character) if learns else safe)
        if plan_now:
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
        return self.settings.wire_tags

    @property
    def broadcast(self) -> bool:
        """True if it receives writes or sends unsolicited frames, and never replies."""
        return not self.health.answerable

    @property
    def state(self) -> State:
        return self.health.state

    @property
    def polled_tags(self) -> list[Tag]:
        """The tags that polls read."""
        areas = self.driver.areas
        return [tag for tag in self.tags if areas[tag.span.area].readable and tag.polled]

    @property
    def longest_reply(self) -> float:
        """Seconds after a request until its reply can no longer arrive."""
        return self.timing.reply_timeout + self.settings.late_guard

    @property
    def usual_turnaround(self) -> float | None:
        """Seconds of the station for a reply, measured or from the file; None: not known yet."""
        return self._usual(self.record.replies.turnaround)

    def _usual(self, measured: float | None) -> float | None:
        given = self.turnaround.configured
        return given if measured is None else max(measured, given or 0.0)

    @property
    def late_from(self) -> float | None:
        """Seconds of the station after which a reply is later than usual; None: not known yet."""
        usual = self.usual_turnaround
        return None if usual is None else late_from(usual)

    def is_unusual(self, turnaround: float) -> bool:
        """Returns True if it is longer than most. A few that another master delayed make no more
        of them usual."""
        usual = self._usual(self.record.replies.typical)
        return usual is not None and turnaround > late_from(usual)

    def may_be_echo(self, turnaround: float, unproven: float) -> bool:
        """Returns True if a reply that equals its request may be its echo, although the adapter
        did not echo before.

        It came sooner than the device ever replied, or no other reply has come without an echo for
        so long. `turnaround`: of the reply; `unproven`: since then.
        """
        quickest = min(self.record.replies.quickest, self.usual_turnaround or 0.0)
        return unproven > ECHO_PROVEN_FOR or turnaround < quickest / 2

    def diagnosis(self) -> str:
        """Returns the likely cause of its trouble as a sentence; empty when there is none."""
        return self.diagnosed().text

    def diagnosed(self) -> Diagnosis:
        """Returns the likely cause of its trouble with its code."""
        driver = self.driver
        trouble = self.health.trouble
        if trouble is None:
            if self.identity is not None and self.identity.why.text:
                return self.identity.why
            if self.shapes is not None and self.shapes.answers_twice:
                return Diagnosis("answers-twice", ANSWERS_TWICE.format(station=driver.station))
            if self.one_at_a_time:
                why = f"It takes one request at a time, not {self.window}: set `window: 1`"
                return Diagnosis("one-at-a-time", why)
            if (found := self.turnaround).gives_way:
                slow, planned = found.slow, found.planned_poll
                return Diagnosis("gives-way", GIVES_WAY.format(slow=slow, planned=planned))
            return NO_TROUBLE
        if isinstance(trouble, NoReply | Garbled) and trouble.evidence is not Evidence.SLOW:
            trouble = self.record.recent.usual() or trouble
        heard = trouble.data if isinstance(trouble, Garbled) and not self.health.online else b""
        if heard and isinstance(driver, KnownReplies) and is_swapped(heard, driver):
            return Diagnosis("swapped", SWAPPED)
        if self.record.recent.port_note and not self.health.online:
            return Diagnosis("port-settings", self.record.recent.port_note)
        return diagnosis(trouble, driver.traits.no_reply_causes)

    def takes_one_at_a_time(self, only: bool) -> None:
        """Notes if the device loses requests that are sent together."""
        self.one_at_a_time = only

    def successor(self, settings: DeviceSettings, bad: KnownBad) -> "Device":
        """Returns the same station with other settings of the file, without a plan yet. A thread
        may do it; `take_over` gives it everything else that was learned. `bad`: addresses."""
        new = Device(settings, self.wire, plan_now=False)
        new.bad_addresses.restore(bad, settings.wire_tags)
        if not self.monitor.allowed:
            new.monitor.forbid(self.monitor.again)
        if settings.turnaround == self.settings.turnaround:
            new.turnaround = self.turnaround
        return new

    def take_over(self, old: "Device") -> None:
        """Takes over the state of the same station. No request to it may be in flight."""
        self.health, self.record, self.use = old.health, old.record, old.use
        self.health.resyncs_elsewhere()
        self.bad_addresses.take_over(old.bad_addresses, {block.span for block in self.blocks})
        self.good_reads.take_over(old.good_reads)
        self.one_at_a_time = old.one_at_a_time
        if self.settings.identity == old.settings.identity:
            self.identity = old.identity
        if (old.silence.safe, old.silence.least) == (self.silence.safe, self.silence.least):
            self.silence = old.silence
        if self.shapes is not None and old.shapes is not None:
            self.shapes.longer.take_over(old.shapes.longer)
            old.shapes.longer, self.shapes = self.shapes.longer, old.shapes

    def restart(self, trouble: LineDown | None = None, note: str = "") -> None:
        """Starts again after the line was opened or lost. `note`: what is wrong with the port."""
        self.record.recent.opened(note)
        self.health.restart(trouble)
        self.monitor.forget()

    # The plan

    def seconds(self, cost: Cost) -> float:
        """Returns the seconds of one transaction with this station."""
        return self.wire.transaction(cost, self.timing, self.turnaround.expected)

    @property
    def transactions(self) -> Transactions:
        """The durations of transactions with this station, for the planner."""
        return Transactions(self.wire, self.timing, self.turnaround.of_plans)

    @property
    def longest_poll(self) -> float:
        """Seconds of its longest poll."""
        longest = max((self.seconds(block.cost) for block in self.blocks), default=0.0)
        return longest * self.settings.verify_reads

    @property
    def settled_after(self) -> float:
        """Seconds without a byte after which no reply to its last requests is under way."""
        return self.longest_poll + QUIET_MARGIN

    @property
    def load_of_proofs(self) -> float:
        """The share of the wire time of the resyncs that prove its reads while extra replies
        arrive. One is for all blocks of one interval, if its reply is told from theirs."""
        if self.shapes is None:
            return 0.0
        proof = self.seconds(PROOF_COST) + self.settled_after
        loops = self.shapes.of_resync(None, 2, self.probe_spans) is None
        most = MOST_HELD if loops or self.may_be_proven(0.0) else 1
        blocks = Counter(block.every for block in self.blocks)
        return sum(math.ceil(count / most) * proof / every for every, count in blocks.items())

    @property
    def is_doubtful(self) -> bool:
        """True while extra replies arrive on its line: each of its reads is proven."""
        return self.shapes is not None and self.shapes.is_wary

    @property
    def load(self) -> float:
        """The share of the wire time that its polls take."""
        once = sum(self.seconds(block.cost) / block.every for block in self.blocks)
        return once * self.settings.verify_reads

    def plan(self) -> None:
        """Plans the blocks that read the tags, without the bad addresses."""
        bad = self.bad_addresses
        if self.settings.listen_only:
            self.poll_nothing()
            return
        blocks = plan(self.tags, self.driver, self.transactions, bad.cuts)
        if self.monitor.allowed:
            blocks = with_monitor_list(blocks, self.driver, self.seconds, bad.bad.keys())
        self.blocks = blocks
        self._set_norm()
        self.good_reads.replan()
        bad.changed.clear()
        if self.shapes is not None:
            self.shapes.longer.planned(blocks)

    def poll_seconds(self, block: Block) -> Sequence[float]:
        """Returns the seconds of one poll of the block: of each span that may be read for it."""
        if self.shapes is None:
            return [self.seconds(block.cost)]
        return [self.seconds(cost) for cost in self.shapes.longer.costs(block)]

    def plan_changes(self) -> float:
        """Plans again around the addresses that turned bad, returned or are split no longer.

        Plans only the blocks that hold them and their neighbours, a limited number at a time: other
        lines wait meanwhile. `bad_addresses.changed` keeps the rest. Returns the estimated seconds.
        """
        bad = self.bad_addresses
        if self.monitor.allowed and self._monitored:  # the list may take tags of any block
            self.plan()
            return self.planning_seconds(self.tags)
        rates = len({tag.every for tag in self.tags})
        blocks = sorted(self.blocks, key=lambda block: block.span)
        near: set[int] = set()
        tags: list[Tag] = []
        for span in sorted(bad.changed):
            for place in set(around(blocks, span)) - near:
                near.add(place)
                tags += blocks[place].tags
            bad.changed.discard(span)
            if len(tags) * rates >= MOST_PLANNED:
                break
        kept = [block for place, block in enumerate(blocks) if place not in near]
        self.good_reads.replan()
        found = plan(tags, self.driver, self.transactions, bad.cuts)
        self.blocks = tuple(sorted((*kept, *found), key=lambda block: block.span))
        self._set_norm()
        if self.shapes is not None:
            self.shapes.longer.planned(self.blocks)
        return self.planning_seconds(tags)

    def _set_norm(self) -> None:
        """Notes how much of the wire its polls take, as long as it is as quick as at first."""
        norm, reads = self.turnaround.norm, self.settings.verify_reads
        polls = [reads * self.wire.transaction(one.cost, self.timing, norm) for one in self.blocks]
        load = sum(took / one.every for took, one in zip(polls, self.blocks, strict=True))
        self.turnaround.replan(self.window * max(polls, default=math.inf), load)

    @property
    def _monitored(self) -> bool:
        driver = self.driver
        return isinstance(driver, Monitor) and any(
            driver.monitor_cost([tag.span]) is not None for tag in self.tags
        )

    def planning_seconds(self, tags: Sequence[Tag]) -> float:
        """Estimates the duration of a plan of these tags, the same on every computer."""
        return PLANNING * len(tags) * len({tag.every for tag in tags})

    def poll_nothing(self) -> None:
        """Removes all polls: only requests of clients are sent."""
        self.blocks = ()

    def learn_turnaround(self) -> bool | None:
        """Plans again if the measured turnaround can make the load smaller.

        Returns True if the plan is another one now, None if nothing was planned. In every case the
        measured one is expected from now on.
        """
        if self.record.exchanges < self.turnaround.look_at:
            return None
        first = self.turnaround.norm is None
        may_plan = self.turnaround.learn(self.record)
        if first:
            self._set_norm()
        if not may_plan or self._planning_takes_long:
            return None
        gain = self._most_gain()
        if gain == 0.0 or gain < WORTH_WHILE * (load := self.load):
            return None
        blocks = self.blocks
        self.plan()
        useful = self.load < (1 - WORTH_WHILE) * load
        self.turnaround.planned(self.record, useful=useful)
        if not useful:
            self.blocks = blocks
        return useful

    def _most_gain(self) -> float:
        """Returns the load that a new plan can save at most.

        The present plan was the cheapest at its turnaround. After a longer one, a plan with fewer
        requests is cheaper by no more than the difference for each request that it saves. After a
        shorter one, it is the same for each additional request.
        """
        change = self.turnaround.change(self.timing.turnaround)
        if change == 0.0:
            return 0.0
        requests = sum(1 / block.every for block in self.blocks)
        if change < 0:
            requests -= sum(1 / tag.every for tag in self.polled_tags)
        elif not (self.monitor.allowed and self._monitored):  # a list needs fewer than any plan
            requests -= self.turnaround.fewest(self._fewest_requests)
        return requests * change * self.settings.verify_reads

    def _fewest_requests(self) -> float:
        """Returns the requests a second of the plan that has the fewest."""
        return requests_a_second(self.tags, self.driver, _alike, self.bad_addresses.cuts)

    @property
    def _planning_takes_long(self) -> bool:
        """True if a new plan would hold up all lines for too long."""
        return len(self.tags) * len({tag.every for tag in self.tags}) > MOST_PLANNED

    def interval(self, block: Block) -> float:
        """Returns the interval of the block; bad addresses are polled only rarely.

        The time-outs of silent addresses hold up the others: all of them together take about
        `SILENT_SHARE` of the time, unless one returned a short time ago.
        """
        known = self.bad_addresses.bad
        bad = known.get(block.span)
        if bad is None:
            return block.every
        pause = bad.retry
        if bad.silent and pause == RETRIES[-1]:
            silent = sum(other.silent for other in known.values())
            pause = max(pause, silent * self.longest_reply / SILENT_SHARE)
        return max(pause, block.every)

    @property
    def probe_spans(self) -> Sequence[Span]:
        """Configured addresses for a resync, those of the last good read first, then the widest
        block that was read: it has room for a read with a form of its own.

        They stay the same from one good read to the next, as `Driver.resync` needs it.
        """
        return (*self.good_reads.spans, *self.good_reads.others(self.bad_addresses, self._sound))

    def _sound(self) -> Sequence[Span]:
        """Returns some configured addresses, without bad ones if there are others."""
        tags = self.polled_tags
        bad = {tag for one in self.bad_addresses.bad.values() for tag in one.tags}
        runs = runs_of([tag for tag in tags if tag not in bad] or tags)
        return runs[:: 1 + len(runs) // MOST_PROBED]

    def may_be_proven(self, now: float) -> bool:
        """Returns True if a resync with the token `PROOF` has a reply that no unanswered request
        has."""
        shapes, asked = self.shapes, self.health.unanswered.spans
        if shapes is None or None in asked or now < shapes.proofs.lacked_until:
            return False
        own = shapes.of_resync(self.health.outstanding, PROOF, self.probe_spans)
        return own is not None and own not in {shapes.of(span) for span in asked if span}

    def spans_beside(self, span: Span | None, token: int) -> Sequence[Span]:
        """Returns the `probe_spans`; none where a resync in them has the form of a read of `span`:
        then it reads near that, in another length."""
        shapes, spans = self.shapes, self.probe_spans
        if shapes is None or span is None:
            return spans
        found = (shapes.of_resync(span, one, spans) for one in (token, token + 1))
        return () if shapes.of(span) in found else spans

    def note_resync(
        self, outstanding: Span | None, token: int, now: float, spans: Sequence[Span] | None = None
    ) -> None:
        """Notes a resync that belongs to another request, or follows another resync."""
        if self.shapes is not None:
            spans = self.probe_spans if spans is None else spans
            self.shapes.also_sent(self.shapes.of_resync(outstanding, token, spans), now)

    # Its share of the wire

    @property
    def is_slow(self) -> bool:
        """True if its last reply took much longer than the file or its first replies say."""
        return self.turnaround.slow > 0.0

    def used(self, now: float, begun: float) -> None:
        """Adds the time since `begun` of a poll or a probe. Past use counts half after `HALF_LIFE`.

        Writes and reads on demand do not count: the device must not lose polls because of them.
        """
        if now > begun:
            more = math.log2(now - begun) + now / HALF_LIFE
            least, most = (self.use, more) if self.use < more else (more, self.use)
            self.use = most + math.log2(1.0 + math.exp2(least - most))


def _alike(_: Cost) -> float:
    """Has a plan take the fewest requests."""
    return 1.0
