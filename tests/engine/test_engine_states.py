"""One engine with five devices: whatever the results and their order, its promises hold."""

import random
from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from math import inf
from typing import Any

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from gateway.engine.device.device import Device
from gateway.engine.device.health import TRANSITIONS, Event, State
from gateway.engine.effects import Effect, OnlineChange, RequestEnded, Samples
from gateway.engine.engine import Engine
from gateway.engine.jobs.jobs import (
    Answer,
    Confirm,
    HeldTogether,
    Identified,
    Identify,
    Idle,
    Job,
    Poll,
    Probe,
    ReadBack,
    Reopen,
    Repeat,
    Result,
    Resynced,
    Sent,
    Settle,
    Settled,
    Traffic,
    Transacted,
    WriteTogether,
    requests_of,
)
from gateway.engine.jobs.requests import Command, Group, Request, Write
from gateway.engine.jobs.runs import together, verified
from gateway.errors import (
    BadValue,
    Garbled,
    GatewayError,
    LineDown,
    NoReply,
    Refusal,
    Refused,
    Unsteady,
)
from gateway.protocols.driver import Span
from gateway.protocols.modbus import ModbusRtu
from gateway.protocols.vigor import Vigor
from gateway.tags import Quality, WriteRule
from tests.engine.rig import SECOND, broadcast_device, link_device, tcp_device
from tests.sim.bench import WIRE
from tests.sim.plant import made_device, make_tag

NO_EVENT: frozenset[Event] = frozenset()
PAUSES = st.sampled_from([0.0, 0.01, 0.3, 1.0, 3.0, 7.0, 100.0])
UNCLEAR = [NoReply("no reply"), Garbled("noise")]
REFUSED = [Refused("refused", code="06", refusal=refusal) for refusal in Refusal]
FAILED: list[Result] = [*UNCLEAR, *REFUSED]
RULES = [
    WriteRule(),
    WriteRule(verify=True),
    WriteRule(repeat=True),
    WriteRule(verify=True, repeat=True),
    WriteRule(latest=True),
]
RESYNCED = (Resynced(0), Resynced(1))
IDENTIFIED = (Identified({"vendor": ["ABB"]}), Identified({"vendor": ["another"]}))
RESYNC = Probe | Settle | Confirm | Repeat  # what goes to a device that needs a resync


def devices() -> list[Device]:
    """A window, a broadcast, scattered writes and commands, and two plain ones."""
    vigor, rtu = Vigor(station=1), ModbusRtu(station=2)
    vigor_tags = [
        make_tag(f"D{n}", vigor, every=e, write=rule)
        for (n, e), rule in zip(
            ((0, 0.5), (1, 0.5), (2, 1.0), (900, 2.0), (901, 2.0)), RULES, strict=True
        )
    ]
    rtu_tags = [make_tag(f"holding:{n}", rtu, every=1.0, write=WriteRule()) for n in (1, 2, 900)]
    return [
        made_device("vigor", vigor, WIRE, vigor.timing, vigor_tags),
        made_device(
            "rtu", rtu, WIRE, rtu.timing, rtu_tags, verify_reads=2, identity={"vendor": "ABB"}
        ),
        tcp_device(),
        broadcast_device(),
        link_device(station=5),
    ]


def events_of(job: Transacted, result: Result) -> set[Event]:
    """The events that the result may bring to the job's device."""
    if isinstance(job, Settle):
        return {Event.RESTARTED if job.device.broadcast else Event.GAVE_UP}
    if isinstance(job, Poll) and job.device.window > 1:
        return {Event.ANSWERED, Event.UNCLEAR}
    unclear = isinstance(result, NoReply | Garbled) and not isinstance(result, Unsteady)
    return {Event.UNCLEAR if unclear else Event.ANSWERED}


def possible(job: Transacted) -> list[Result]:
    """Every result that the job can have, but for the loss of the port."""
    match job:
        case Poll():
            return [[7] * job.span.size, Unsteady("differ"), *FAILED]
        case Probe() | Identify():
            return [*(RESYNCED if isinstance(job, Probe) else IDENTIFIED), *FAILED]
        case Settle():
            return [Settled(None), Settled(0.1)]
        case Command():
            return ["done", BadValue("argument"), *FAILED]
        case Answer():
            return [None, Garbled("noise")]
        case WriteTogether(writes=writes, run=run):
            return [Sent(), *FAILED] if run is None else possible_of_run(writes, run)
        case ReadBack(writes=writes):
            held = [list(write.units) for write in writes]
            refused = Refused("no such address", code="06", refusal=Refusal.ADDRESS)
            return [HeldTogether(held), HeldTogether([refused] * len(held)), *UNCLEAR]
        case Confirm(writes=[_, _, *_] as writes, run=run):
            return [Sent(held=units_of(writes, run)), Sent(held=[12345] * run.size), *FAILED]
        case Write() | Confirm() | Repeat():
            return possible_of_write(job)


def units_of(writes: Sequence[Write], run: Span) -> list[int]:
    return together(run, writes, [0] * run.size)


def possible_of_run(writes: Sequence[Write], run: Span) -> list[Result]:
    if not any(verified(write.tag) for write in writes):
        return [Sent(), *FAILED]
    results: list[Result] = [Sent(held=units_of(writes, run)), Sent(held=[12345] * run.size)]
    return [*results, Sent(refused_back=REFUSED[0]), *FAILED]


def possible_of_write(job: Write | Confirm | Repeat) -> list[Result]:
    match job:
        case Confirm(writes=writes):
            [write] = writes
        case Repeat():
            write = job.write
        case _:
            write = job
    if job.device.broadcast:
        return [Sent(acknowledged=False), Sent(), *UNCLEAR]
    if write.tag.write is None or not write.tag.write.verify:
        return [Sent(), *FAILED]
    results: list[Result] = [Sent(held=list(write.units)), Sent(held=[12345]), *FAILED]
    return results if isinstance(job, Confirm) else [*results, Sent(refused_back=REFUSED[0])]


class Machine(RuleBasedStateMachine):
    """A line of any luck. The clock only goes on."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 0.0
        self.devices = devices()
        self.engine = Engine("line", self.devices, WIRE)
        self.states = {device: device.state for device in self.devices}
        self.online = dict.fromkeys(self.devices, False)  # by the effects
        self.submitted = list[Request]()
        self.ended = set[Request]()
        self.in_flight: list[Transacted] = []
        self.groups: dict[Group, list[Write]] = {}
        self.failed = set[Group]()  # one of its writes was not done
        self.open()

    @property
    def time(self) -> int:
        return int(self.now * SECOND)

    def note(
        self,
        effects: Sequence[Effect],
        device: Device | None = None,
        events: AbstractSet[Event] = NO_EVENT,
    ) -> None:
        """Checks the effects, and that only these events changed the state of this device."""
        for one, before in self.states.items():
            allowed = {TRANSITIONS[before, event] for event in events if one is device}
            assert one.state is before or one.state in allowed
            self.states[one] = one.state
        for effect in effects:
            match effect:
                case RequestEnded(request, outcome):
                    assert request in self.submitted
                    assert request not in self.ended, "a request has one outcome"
                    self.ended.add(request)
                    if isinstance(request, Write) and isinstance(outcome, GatewayError):
                        self.failed |= {one for one in self.groups if one is request.group}
                case OnlineChange(device, online):
                    self.online[device] = online
                case Samples(samples):
                    for sample in samples:
                        if sample.quality is Quality.GOOD:
                            [of] = [one for one in self.devices if sample.tag in one.tags]
                            assert self.engine.is_open
                            assert of.health.online
                            assert of.identity is None or of.identity.is_usable
                            assert self.online[of], (
                                "the device comes online before its first sample"
                            )

    def take(self) -> Job:
        """The next job, and the promises on it."""
        waited = {device: device.health.needs_resync for device in self.devices}
        job = self.engine.next(self.now)
        if isinstance(job, Idle):
            assert job.until > self.now
            return job
        if isinstance(job, Reopen):
            assert not any(device.health.state is State.ONLINE for device in self.devices)
            return job
        if not isinstance(job, Repeat | Settle | Confirm | ReadBack):
            for request in requests_of(job):
                assert request.expires > self.now, "no request is sent after its expiry"
        assert all(request not in self.ended for request in requests_of(job))
        if isinstance(job, Write | WriteTogether):
            self.in_order([one for one in requests_of(job) if isinstance(one, Write)])
        if waited[job.device]:
            assert isinstance(job, RESYNC)
        if isinstance(job, Poll | Write | WriteTogether | Command):
            assert job.device.identity is None or job.device.identity.is_usable
        if isinstance(job, Poll):
            [entry] = [e for e in self.engine.schedule.polls(job.device) if e.job is job]
            assert job.device.health.online
            assert entry.due <= self.now
        if isinstance(job, Probe):
            assert not job.device.broadcast
        return job

    def in_order(self, writes: Sequence[Write]) -> None:
        for write in writes:
            if write.group is not None:
                assert write.group not in self.failed, "the rest of a group is not sent"
                members = self.groups[write.group]
                before = members[: members.index(write)]
                assert all(one in self.ended or one in writes for one in before)

    def expire(self) -> None:
        self.note(self.engine.expire(self.now, self.time))
        assert self.engine.deadline > self.now

    # Rules

    @rule(seconds=PAUSES)
    def time_passes(self, seconds: float) -> None:
        self.now += seconds
        if self.engine.deadline <= self.now:
            self.expire()

    @precondition(lambda self: self.engine.is_open and not self.in_flight)
    @rule()
    def next(self) -> None:
        job = self.take()
        if isinstance(job, Idle):
            return
        if isinstance(job, Reopen):
            self.lose(concluded=False)
            return
        self.in_flight = [job]
        if isinstance(job, Poll) and job.device.window > 1:
            others = self.engine.alongside(job, self.now)
            assert len(others) < job.device.window
            assert {other.device for other in others} <= {job.device}
            self.in_flight += others

    @precondition(lambda self: self.in_flight)
    @rule(data=st.data(), seconds=PAUSES, sent=st.booleans())
    def conclude(self, data: Any, seconds: float, sent: bool) -> None:
        self._conclude(data.draw(st.integers(0, 99)), seconds, sent=sent)

    @precondition(lambda self: self.engine.is_open)
    @rule(seed=st.integers(0, 2**32), trouble=st.sampled_from([0.0, 0.1, 0.3, 0.8]))
    def several(self, seed: int, trouble: float) -> None:
        """Twenty jobs in a row, and requests between them."""
        chance = random.Random(seed)
        for _ in range(20):
            for _ in range(chance.choice([0, 0, 0, 1, 3])):
                self.write(chance.randrange(100), chance.randrange(2))
            if chance.random() < 0.2:
                self.group(chance.randrange(5), chance.randrange(100))
            if chance.random() < 0.05:
                self.command(4, "stop")
            if not self.in_flight:
                self.next()
            if not self.engine.is_open:
                return
            while self.in_flight:
                number = chance.randrange(100) if chance.random() < trouble else 0
                self._conclude(number, chance.choice([0.02, 0.02, 0.02, 0.6]), sent=True)

    def _conclude(self, number: int, seconds: float, *, sent: bool) -> None:
        job = self.in_flight.pop(number % len(self.in_flight))
        self.time_passes(seconds)
        results = possible(job)
        result = results[number % len(results)]
        replied = not isinstance(result, NoReply | Garbled | Settled)
        traffic = Traffic(17 if sent or replied else 0, 20 * replied, int(replied), 0.005 * replied)
        effects = self.engine.conclude(job, result, traffic, self.now, self.time)
        self.note(effects, job.device, events_of(job, result))
        if isinstance(job, Poll) and isinstance(result, list) and not self.in_flight:
            assert job.device.window > 1 or job.device.state is State.ONLINE
            assert job.device.window > 1 or not job.device.health.needs_resync

    @precondition(lambda self: self.in_flight)
    @rule()
    def a_job_in_flight_is_the_only_one(self) -> None:
        try:
            self.engine.next(self.now)
        except AssertionError:
            return
        raise AssertionError("a second job was handed out")

    @rule(which=st.integers(0, 99), value=st.integers(0, 1))
    def write(self, which: int, value: int) -> None:
        pairs = [(device, tag) for device in self.devices for tag in device.tags]
        device, tag = pairs[which % len(pairs)]
        self._submit(Write(device, tag, tag.encode(value), self.now))

    @rule(which=st.integers(0, 4), seed=st.integers(0, 99))
    def group(self, which: int, seed: int) -> None:
        device, group, chance = self.devices[which], Group(), random.Random(seed)
        tags = chance.sample(device.tags, chance.randrange(1, len(device.tags) + 1))
        writes = [Write(device, tag, tag.encode(1), self.now, group=group) for tag in tags]
        self.groups[group] = writes
        self.submitted += writes
        self.note(self.engine.submit_group(writes, self.now))

    @rule(which=st.integers(0, 4), name=st.sampled_from(["stop", "model", "fly"]))
    def command(self, which: int, name: str) -> None:
        self._submit(Command(self.devices[which], name, "", self.now))

    def _submit(self, request: Request) -> None:
        self.submitted.append(request)
        self.note(self.engine.submit(request, self.now))

    @rule(which=st.integers(0, 99))
    def expedite(self, which: int) -> None:
        pairs = [(device, tag) for device in self.devices for tag in device.tags]
        self.engine.expedite(*pairs[which % len(pairs)])

    @rule(data=st.binary(min_size=1, max_size=20))
    def receive(self, data: bytes) -> None:
        if not self.in_flight:
            self.note(self.engine.received(data, self.now, self.time))

    @precondition(lambda self: self.engine.is_open)
    @rule(concluded=st.booleans())
    def lose(self, concluded: bool) -> None:
        """The port is lost in the middle of a job, or between two."""
        error = LineDown("unplugged")
        if concluded:
            for job in self.in_flight:
                result = Settled(None) if isinstance(job, Settle) else error
                effects = self.engine.conclude(job, result, Traffic(17), self.now, self.time)
                self.note(effects, job.device, events_of(job, result))
        self.in_flight = []
        effects = self.engine.lost(error, self.now, self.time)
        self._restarted()
        self.note(effects)
        self._closed()

    @precondition(lambda self: not self.engine.is_open)
    @rule()
    def open(self) -> None:
        effects = self.engine.opened(self.now)
        self._restarted()
        self.note(effects)

    def _restarted(self) -> None:
        self.states = dict.fromkeys(self.devices, State.STARTING)

    def _closed(self) -> None:
        assert not self.engine.is_open
        assert set(self.submitted) == self.ended, "every request has its outcome"
        assert self.engine.deadline == inf

    def teardown(self) -> None:
        """The gateway stops, in the middle of a job or not."""
        self.note(self.engine.stopped(self.now))
        self._closed()

    # Invariants

    @invariant()
    def the_effects_tell_which_devices_are_online(self) -> None:
        if self.engine.is_open:
            assert self.online == {device: device.health.online for device in self.devices}

    @invariant()
    def a_request_waits_is_in_flight_or_has_ended(self) -> None:
        waiting = set(self.engine.schedule.requests.waiting)
        assert not waiting & self.ended
        assert all(request.device.health.state for request in waiting)

    @invariant()
    def a_broadcast_device_is_never_offline_and_needs_no_resync(self) -> None:
        for device in self.devices:
            if device.broadcast:
                assert device.state is not State.OFFLINE
                assert not device.health.needs_resync


Machine.TestCase.settings = settings(max_examples=50, stateful_step_count=50, deadline=None)
TestMachine = Machine.TestCase
