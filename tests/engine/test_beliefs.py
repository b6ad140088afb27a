"""No belief is for ever: each is contradicted after an hour of its truth, and given up in time."""

from collections.abc import Callable
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from gateway.engine.device.health import FORGOTTEN, State
from gateway.engine.device.identity import SILENT_TRIES, Identity, Verdict
from gateway.engine.device.probe_pace import PROBE_PAUSE, PROBE_SPREAD
from gateway.engine.device.records import QUICKEST_OF, Replies
from gateway.engine.device.reply_shapes import ProofPace
from gateway.engine.device.turnaround import LEARN_EVERY
from gateway.engine.device.twins import Twins
from gateway.engine.jobs.jobs import Idle, Poll, Probe, Resynced, Sent, Settle, Settled, Traffic
from gateway.engine.jobs.poll_entry import OWED, BlockReads
from gateway.engine.jobs.requests import Write
from gateway.engine.jobs.unanswered import Unanswered
from gateway.engine.results.bit_writes import BitWrites
from gateway.engine.results.busy_devices import BusyDevices
from gateway.engine.results.giving_way import GivingWay
from gateway.engine.results.pipelining import Pipelining
from gateway.engine.results.shorter_silences import ShorterSilences
from gateway.engine.schedule.probes import is_noisy
from gateway.errors import Evidence, Garbled, NoReply, Refusal, Refused
from gateway.line.channel import Echo
from gateway.planning.planner import Block
from gateway.protocols.resync_kind import ResyncKind
from gateway.tags import WriteRule
from tests.engine.beliefs import BELIEFS, Belief, table
from tests.engine.rig import SILENCE, UNANSWERED, Rig, bit_device, link_device, tcp_device
from tests.sim.plant import device, make_tag

HOUR = 3600.0
PAGE = Path(__file__).parents[2] / "docs" / "contributors" / "beliefs.md"
ASKED, SAID = b"\x01\x03\x00\x00\x00\x01", b"\x01\x03\x02\x00\x07"
BUSY = Refused("busy", code="06", refusal=Refusal.BUSY)
NO_ADDRESS = Refused("no such address", code="07", refusal=Refusal.ADDRESS)
Way = Callable[[float], bool]  # is it given up, so many seconds after the contradiction?


def test_the_page_has_the_table_of_the_code() -> None:
    assert table() in PAGE.read_text("utf-8")


def echo(*, first: bytes, then: bytes) -> Way:
    adapter = Echo("line", None)
    for _ in range(int(HOUR)):
        adapter.learn(ASKED, first, len(SAID))
    before = adapter.found
    adapter.learn(ASKED, then, len(SAID))
    return lambda _: adapter.found is not before


def turnaround() -> Way:
    device = link_device()

    def answered(count: int, seconds: float) -> None:
        for _ in range(count):
            device.record.count_exchanges(1, 0.01, seconds)
            device.learn_turnaround()

    answered(int(HOUR), 0.005)

    def given_up(replies: float) -> bool:
        answered(2 * int(replies), 0.25)
        return (device.turnaround.expected or 0.0) > 0.2

    return given_up


def quickest() -> Way:
    replies = Replies()
    for _ in range(int(HOUR)):
        replies.count(0.01)
    before = replies.soonest
    assert 0.0 < before < 0.01
    replies.count(0.004)
    return lambda _: replies.soonest <= 0.002


def rule_of(rig: Rig, kind: type[Any]) -> Any:
    return next(rule for rule in rig.engine.rules.all if isinstance(rule, kind))


def shorter_silence() -> Way:
    rig = Rig(link_device())
    rule: ShorterSilences = rule_of(rig, ShorterSilences)
    device, rule.step = rig.device, 3
    device.silence.take_step(3, HOUR)
    device.silence.keep(device.silence.shorter)
    rule.failed(device, NoReply("no reply"), device.silence.safe / 8, HOUR)
    return lambda _: rule.step == 0 and device.silence.kept == device.silence.safe


def silence_too_short() -> Way:
    silence = link_device().silence
    silence.least = silence.safe / 8  # it may be shortened
    silence.was_too_short(silence.safe / 2, 0.0)

    def given_up(after: float) -> bool:
        silence.take_step(3, after)
        return silence.shorter < silence.safe

    assert not given_up(HOUR - 1)
    return given_up


def answers_twice() -> Way:
    shapes = link_device().shapes
    assert shapes is not None
    usual = shapes.quiet
    for second in range(0, int(HOUR), 60):
        shapes.extra_arrived(float(second))
    last = HOUR - 60

    def given_up(after: float) -> bool:
        shapes.marked(last + after)
        return shapes.quiet == usual

    assert not given_up(60.0)
    return given_up


def _twins(is_given_up: Callable[[Twins, float], bool]) -> Way:
    known = Twins()
    for second in range(int(HOUR)):
        known.asked()
        known.replied((7, lambda frame: frame))
        known.arrived(8, float(second))
    assert not is_given_up(known, HOUR)
    return lambda after: is_given_up(known, HOUR - 1 + after)


def twins() -> Way:
    return _twins(lambda known, now: not known.exist(now))


def twins_before() -> Way:
    return _twins(lambda known, now: not known.may_reply(now))


def one_at_a_time() -> Way:
    rig = Rig(tcp_device())
    rule: Pipelining = rule_of(rig, Pipelining)
    device = rig.device
    one, other = (Poll(device, block, block.span) for block in device.blocks[:2])
    for _ in range(3):
        rule._ended(one, 2, [one], 0.0)
        rule._ended(one, 1, [], 0.0)
    assert device.one_at_a_time
    assert rule.beside(other, HOUR - 1) == 0

    def given_up(after: float) -> bool:
        if rule.beside(other, after) > 0:
            rule._ended(one, 2, [], after)
        return not device.one_at_a_time

    return given_up


def polls_until(rig: Rig, end: float, result: Callable[[Poll], Any]) -> None:
    """Performs all jobs until then."""
    while rig.now < end:
        job = rig.next()
        match job:
            case Idle(until):
                rig.now = min(until, end)
            case Poll():
                rig.conclude(job, result(job))
            case Probe():
                rig.conclude(job, Resynced(9))
            case Settle():
                rig.conclude(job, Settled(None))
            case _:
                raise AssertionError(job)


def refused_address() -> Way:
    rig = Rig(link_device())
    rig.bring(State.ONLINE)

    def without_d3(poll: Poll) -> Any:
        _, start, size = poll.span
        return NO_ADDRESS if start <= 3 < start + size else [0] * size

    polls_until(rig, HOUR, without_d3)
    assert rig.device.bad_addresses.bad
    end = rig.now

    def given_up(after: float) -> bool:
        polls_until(rig, end + after + 5.0, lambda poll: [0] * poll.span.size)
        return not rig.device.bad_addresses.bad and len(rig.device.blocks) == 1

    return given_up


def fell_silent() -> Way:
    device = link_device()
    (block, *_), bad = device.blocks, device.bad_addresses
    for _ in range(int(HOUR)):
        bad.fell_silent(block)
        bad.went_silent(block)
    assert bad.is_suspect(block.span)

    def given_up(_: float) -> bool:
        bad.read(block)
        bad.fell_silent(block)  # it begins to count again
        return not bad.is_suspect(block.span)

    return given_up


def silent_about_a_read() -> Way:
    device, found = link_device(), []
    block = device.blocks[0]
    for certain in (False, True):
        reads = BlockReads()
        for _ in range(int(HOUR)):
            reads.was_silent()
        for _ in range(OWED - 1):
            reads.replied()
        assert reads.owed
        if certain:
            reads.take(block, [0] * block.span.size, HOUR, 0)
        else:
            reads.replied()
        found.append(reads)
    return lambda _: not any(reads.owed for reads in found)


def block_too_long() -> Way:
    rig = Rig(link_device())
    rig.bring(State.ONLINE)

    def short_ones(poll: Poll) -> Any:
        return NO_ADDRESS if poll.span.size > 4 else [0] * poll.span.size

    polls_until(rig, HOUR, short_ones)
    assert rig.device.bad_addresses.splits
    end = rig.now

    def given_up(after: float) -> bool:
        polls_until(rig, end + min(after, HOUR), lambda poll: [0] * poll.span.size)
        return not rig.device.bad_addresses.splits

    return given_up


def monitor_list() -> Way:
    monitor = link_device().monitor
    monitor.refused(0.0)
    assert not monitor.allowed
    rig = Rig(link_device())
    rig.bring(State.ONLINE)
    rig.device.monitor.refused(0.0)
    replans = rig.engine._polls._replans
    replans.want(rig.device, 0.0)

    def given_up(after: float) -> bool:
        polls_until(rig, after + 5.0, lambda poll: [0] * poll.span.size)
        return rig.device.monitor.allowed

    return given_up


def longer_read() -> Way:
    shapes = link_device().shapes
    assert shapes is not None
    longer = shapes.longer
    block: Block = link_device().blocks[0]
    usual = longer.choices(block.span)
    for refused in usual[1:]:
        longer.refused(block.span, refused[0], 0.0)
    assert longer.choices(block.span) != usual

    def given_up(after: float) -> bool:
        shapes.marked(after)
        return longer.choices(block.span) == usual

    assert not given_up(HOUR - 1)
    return given_up


class Numbered:
    """A frame with a number."""

    def __init__(self, transaction: int) -> None:
        self.transaction = transaction


def bridge_waits() -> Way:
    bridge, device = Unanswered(), tcp_device()

    def held(wait: float, now: float) -> None:
        bridge.timed_out(device, Numbered(1), lambda _: None, now - wait)
        bridge.answered(now - 0.01, now)

    held(9.0, 100.0)
    held(1.0, HOUR)
    assert bridge.longest == 9.0

    def given_up(after: float) -> bool:
        held(1.0, 100.0 + after)
        return bridge.longest == 1.0

    return given_up


def changes_no_bits() -> Way:
    rig = Rig(bit_device())
    rig.bring(State.ONLINE)
    rule: BitWrites = rule_of(rig, BitWrites)
    tag = rig.device.tags[0]

    def is_masked(now: float) -> bool:
        write = Write(rig.device, tag, [1], now)
        rule.before(write, now)
        return write.masked

    write = Write(rig.device, tag, [1], 0.0, masked=True)
    rule.concluded(write, Sent(), Traffic(), 0.0, 0)
    for now in (HOUR - 1, HOUR):
        assert is_masked(now)
        rule.concluded(write, SILENCE, Traffic(), now, 0)
    assert not is_masked(HOUR)
    return lambda after: is_masked(HOUR + after)


def silent_about_identity() -> Way:
    identity = Identity({"vendor": "ABB"})
    for _ in range(SILENT_TRIES):
        identity.unanswered(HOUR)
    assert identity.verdict is Verdict.UNTOLD
    identity.doubt(HOUR + 60)
    assert identity.is_usable

    def given_up(after: float) -> bool:
        return identity.due <= HOUR + after

    return given_up


def busy() -> Way:
    rule, device = BusyDevices(), link_device()
    poll = Poll(device, device.blocks[0], device.blocks[0].span)
    for second in range(0, int(HOUR), 60):
        rule.concluded(poll, BUSY, Traffic(), float(second), 0)
    last = HOUR - 60
    assert rule.free(device, last) > last

    def given_up(after: float) -> bool:
        assert rule.free(device, last + after) <= last + after  # it is polled
        rule.concluded(poll, [0], Traffic(), last + after, 0)
        return rule.free(device, last + after) <= last + after

    return given_up


def takes_more_than_planned() -> Way:
    device = link_device()
    for _ in range(LEARN_EVERY):
        device.record.count_exchanges(1, 0.01, device.timing.turnaround)
    device.learn_turnaround()
    for _ in range(int(HOUR)):
        device.turnaround.replied(10 * device.turnaround.planned_poll)
    assert device.is_slow
    device.turnaround.replied(device.timing.turnaround)
    return lambda _: not device.is_slow


def no_good_value() -> Way:
    rig = Rig(link_device(), link_device(station=2))
    (rule,) = (one for one in rig.engine.rules.all if isinstance(one, GivingWay))
    rig.device.health.answered(resynced=True)
    (entry,) = rig.engine.schedule.polls(rig.device)
    for second in range(0, int(HOUR), 10):
        rule.concluded(entry.job, NO_ADDRESS, UNANSWERED, float(second), 0)
    assert rule.takes(rig.device, HOUR)
    rig.engine.schedule.read(entry, [0] * entry.block.span.size, HOUR, 0)
    return lambda _: not rule.takes(rig.device, HOUR)


def offline() -> Way:
    health = link_device().health
    for second in range(0, int(HOUR), 4):
        health.unclear(SILENCE, None, float(second))
        health.gave_up(float(second), 1 + PROBE_SPREAD)
    last = HOUR - 4

    def given_up(after: float) -> bool:
        assert health.probes.due <= last + after + 1e-6
        return health.answered() and health.online

    return given_up


def never_read() -> Way:
    tag = make_tag("D10", write=WriteRule(polled=False))
    health = device([tag]).health
    assert not health.needs_resync
    health.unclear(SILENCE, None, HOUR)
    assert health.needs_resync

    def given_up(after: float) -> bool:
        health.gave_up(HOUR, 1 + PROBE_SPREAD)
        while health.needs_resync:  # each probe of it fails too
            probed = health.probes.due
            health.unclear(SILENCE, None, probed)
            health.gave_up(probed, 1 + PROBE_SPREAD)
        return health.state is State.STARTING and FORGOTTEN <= probed - HOUR <= after

    return given_up


def polls_until_online(rig: Rig, job: Any) -> None:
    for _ in range(4):
        if isinstance(job, Probe):
            rig.conclude(job, Resynced(99))
        elif isinstance(job, Settle):
            rig.conclude(job, Settled(None))
        else:
            return
        job = rig.next()


def noise() -> Way:
    one, spoilt = link_device(), Garbled("wrong sum", evidence=Evidence.CHECKSUM)
    for second in range(int(HOUR) + 1):
        one.health.unclear(spoilt, None, float(second))
    assert is_noisy(one, [one], HOUR)
    late = link_device()
    late.health.unclear(spoilt, None, HOUR)
    late.health.replied_late(0.7, 0.5, HOUR, last=False)
    return lambda after: not (is_noisy(one, [one], HOUR + after) or is_noisy(late, [late], HOUR))


def no_form_of_its_own() -> Way:
    pace = ProofPace()
    pace.lacks(HOUR)
    return lambda after: pace.lacked_until <= HOUR + after


def silent_about_seconds() -> Way:
    pace = ProofPace()
    pace.lacks_seconds(HOUR)
    return lambda after: pace.seconds_from <= HOUR + after


def kind_of_resync() -> Way:
    kinds, tokens = (ResyncKind(), ResyncKind()), count(2, 2)

    def asked(kind: ResyncKind, answered: bool | None) -> bool:
        """Sends a resync to a station that answers loopbacks, or else reads; None: neither."""
        token = next(tokens)
        loopback = kind.is_loopback(token)
        with suppress(NoReply), kind.sent(token, loopback=loopback):
            if loopback is not answered:
                raise NoReply("no reply")
        return loopback

    for one, loops in zip(kinds, (True, False), strict=True):
        for _ in range(int(HOUR)):
            asked(one, loops)
        assert all(asked(one, loops) is loops for _ in range(20))

    def given_up(after: float) -> bool:
        probes = int(after / (PROBE_PAUSE * (1 + PROBE_SPREAD)))
        for one in kinds:
            for _ in range(probes):
                asked(one, None)
        return all(len({asked(one, None) for _ in range(3)}) == 2 for one in kinds)

    return given_up


def later_than_its_guard() -> Way:
    health = link_device().health
    health.left_outstanding(None, HOUR)
    health.spoke(HOUR + 0.5, 1.0)
    assert health.probes.lateness(HOUR + 1.0)
    return lambda after: not health.probes.lateness(HOUR + 0.5 + after)


def as_quick_as_before() -> Way:
    health, now = link_device().health, HOUR
    health.unclear(SILENCE, None, now)
    health.gave_up(now, 1.0)
    health.spoke(now + 0.25, 1.0)
    return lambda _: health.probes.patient and health.probes.due <= now + 0.25


def kept_requests() -> Way:
    rig = Rig(link_device())
    rig.engine.inherits()
    probe = rig.transacted()
    rig.conclude(probe, Resynced(1))
    polls_until_online(rig, rig.next())
    return lambda _: not rig.engine._next_job.inherits and rig.device.state is State.ONLINE


WAYS: dict[str, Callable[[], Way]] = {
    "the adapter echoes": lambda: echo(first=ASKED + SAID, then=SAID),
    "the adapter does not echo": lambda: echo(first=SAID, then=ASKED + SAID),
    "turnaround": turnaround,
    "a reply cannot come sooner": quickest,
    "a shorter silence is enough": shorter_silence,
    "a silence is too short": silence_too_short,
    "answers twice": answers_twice,
    "two stations have its number": twins,
    "two stations had its number a short time ago": twins_before,
    "takes one request at a time": one_at_a_time,
    "refused address": refused_address,
    "a block may hold an address about which the device is silent": fell_silent,
    "the station was silent about a read": silent_about_a_read,
    "block too long": block_too_long,
    "refuses monitor lists": monitor_list,
    "refuses a longer read": longer_read,
    "a bridge waits for a dead unit": bridge_waits,
    "does not change bits by itself": changes_no_bits,
    "is silent about its identity": silent_about_identity,
    "a device is busy": busy,
    "a device takes more of the wire than planned": takes_more_than_planned,
    "a device that replies has no good values": no_good_value,
    "a device is offline": offline,
    "a device that is never read does not answer": never_read,
    "noise destroys its replies": noise,
    "the device lacks a read with a form of its own": no_form_of_its_own,
    "the device is silent about second requests of resyncs": silent_about_seconds,
    "the kind of resync that a station answers": kind_of_resync,
    "a station replies later than late_guard": later_than_its_guard,
    "a device that returns is as quick as before": as_quick_as_before,
    "earlier requests are kept": kept_requests,
}


@pytest.mark.parametrize("belief", BELIEFS, ids=lambda one: one.name)
def test_a_belief_that_is_contradicted_is_given_up_in_time(belief: Belief) -> None:
    given_up = WAYS[belief.name]()
    assert given_up(belief.within)


def test_every_belief_has_a_way_back() -> None:
    assert WAYS.keys() == {belief.name for belief in BELIEFS}


def test_damaged_replies_are_a_sign_of_life() -> None:
    health = link_device().health
    damaged = Garbled("wrong sum", b"x", evidence=Evidence.CHECKSUM)
    for second in range(10):
        health.unclear(damaged, None, float(second))
        health.gave_up(float(second), 1.0)
        assert health.probes.due < second + 0.1
    health.unclear(SILENCE, None, 60.0)
    health.gave_up(60.0, 1.0)
    assert health.probes.due >= 61.0


def test_a_reply_comes_too_soon_only_after_many_and_with_the_true_baudrate() -> None:
    replies = Replies()
    for _ in range(QUICKEST_OF - 1):
        replies.count(0.01)
        assert not replies.is_too_soon(-0.02, 0.01)
    replies.count(0.01)
    assert replies.soonest == pytest.approx(0.005)
    assert replies.is_too_soon(0.004, 0.01)
    assert not replies.is_too_soon(0.005, 0.01)
    replies.count(0.0, -0.5)  # another reply: the station itself is as quick as before
    assert replies.is_too_soon(-0.005, 0.01)
    for _ in range(2 * QUICKEST_OF):
        replies.count(0.0, -0.5)  # the wire is faster than the file says
    assert not replies.is_too_soon(-0.005, 0.01)
    assert replies.is_too_soon(-0.006, 0.01)
    replies.count(0.0, -0.9)  # a longer read
    assert not replies.is_too_soon(-0.009, 0.01)


def test_a_reply_without_any_turnaround_comes_too_soon_before_its_characters_are_over() -> None:
    replies = Replies()
    for _ in range(QUICKEST_OF):
        replies.count(0.0)
    assert replies.is_too_soon(-0.004, 0.03)
    assert not replies.is_too_soon(-0.0001, 0.03)  # the clock of a station may be fast
