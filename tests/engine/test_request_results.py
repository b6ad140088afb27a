"""One write from its submission to its outcome, as a table: the rules of its tag decide."""

from typing import Any

import pytest

from gateway.engine.device.health import State
from gateway.engine.effects import Pause
from gateway.engine.jobs.jobs import (
    Confirm,
    HeldTogether,
    Probe,
    ReadBack,
    Repeat,
    Result,
    Resynced,
    Sent,
    Settle,
    Settled,
    Traffic,
    Transacted,
    WriteTogether,
)
from gateway.engine.jobs.requests import WRITE_EXPIRY, Command, Write
from gateway.engine.results.request_rules import BROADCAST_PAUSE, STOPPED, Differs
from gateway.errors import Busy, Garbled, NoReply, Refusal, Refused, Unclear
from gateway.planning.bad_addresses import BadRange
from gateway.protocols.driver import Span
from gateway.tags import WriteResult
from tests.engine.rig import LOST, REPLIED, Rig, broadcast_device, ended

HELD, OLD = Sent(held=[7]), Sent(held=[0])
DAMAGED = Refused("sum check error", code="02", refusal=Refusal.DAMAGED, unexecuted=True)
NO_ADDRESS = Refused("no such device", code="06", refusal=Refusal.ADDRESS)
OK, NO, GONE = Sent(), Refused("not in RUN", code="18"), NoReply("no reply")
NOISE = Garbled("noise")
TAGS = {"plain": "D0", "verify": "D2", "repeat": "D3", "both": "D4"}

# The rule of the tag; the results of the write's jobs one by one; the jobs; the outcome.
# After each unclear result the line settles.
TABLE: list[tuple[str, list[Result], str, str]] = [
    ("plain", [OK], "Write", "written"),
    ("plain", [NO], "Write", "Refused"),
    ("plain", [GONE], "Write", "NoReply"),
    ("plain", [NOISE], "Write", "Garbled"),
    ("verify", [HELD], "Write", "verified"),
    ("verify", [OLD], "Write", "Differs"),
    ("verify", [Sent(refused_back=NO)], "Write", "Differs"),
    ("verify", [NO], "Write", "Refused"),
    ("verify", [GONE, HELD], "Write Confirm", "verified"),
    ("verify", [GONE, OLD], "Write Confirm", "NoReply"),
    ("verify", [NOISE, OLD], "Write Confirm", "Garbled"),
    ("verify", [NOISE, NO], "Write Confirm", "Garbled"),
    ("verify", [NOISE, GONE], "Write Confirm", "Garbled"),
    ("repeat", [OK], "Write", "written"),
    ("repeat", [NO], "Write", "Refused"),
    ("repeat", [GONE, OK, OK], "Write Confirm Repeat", "written"),
    ("repeat", [NOISE, OK, GONE], "Write Confirm Repeat", "Garbled"),
    ("repeat", [NOISE, OK, NO], "Write Confirm Repeat", "Garbled"),
    ("repeat", [NOISE, GONE], "Write Confirm", "Garbled"),
    ("repeat", [NOISE, NO], "Write Confirm", "Garbled"),
    ("both", [GONE, HELD], "Write Confirm", "verified"),
    ("both", [GONE, OLD, HELD], "Write Confirm Repeat", "verified"),
    ("both", [GONE, OLD, OLD], "Write Confirm Repeat", "Differs"),
    ("both", [NOISE, OLD, GONE], "Write Confirm Repeat", "Garbled"),
    ("both", [NOISE, OLD, NO], "Write Confirm Repeat", "Garbled"),
    ("both", [GONE, OLD, Sent(refused_back=NO)], "Write Confirm Repeat", "Differs"),
]


def online() -> Rig:
    rig = Rig()
    rig.bring(State.ONLINE)
    return rig


def settle(rig: Rig) -> None:
    job = rig.next()
    assert isinstance(job, Settle)
    rig.conclude(job, Settled(None))


@pytest.mark.parametrize(
    ("rule", "results", "jobs", "outcome"),
    TABLE,
    ids=[f"{rule}-{outcome}-{n}" for n, (rule, _, _, outcome) in enumerate(TABLE)],
)
def test_the_rule_of_the_tag_decides_the_jobs_and_the_outcome_of_a_write(
    rule: str, results: list[Result], jobs: str, outcome: str
) -> None:
    rig, done = online(), list[str]()
    write = rig.write(TAGS[rule])
    for result in results:
        assert write not in rig.outcomes
        job = rig.transacted()
        done.append(type(job).__name__)
        rig.conclude(job, result)
        if isinstance(result, Unclear):
            settle(rig)
    assert " ".join(done) == jobs
    assert ended(rig.outcomes[write]) == outcome
    assert rig.device.record.writes == 1
    assert not isinstance(rig.next(), Confirm | Repeat | Write)


def test_an_acknowledged_write_has_its_value_and_its_times() -> None:
    rig = online()
    write = rig.write("D0", 5)
    rig.now += 0.5
    rig.conclude(rig.transacted(), OK, took=0.25)
    done = rig.outcomes[write]
    assert isinstance(done, WriteResult)
    assert (done.value, done.verified, done.acknowledged) == (5, False, True)
    assert done.time == rig.time
    assert done.took == pytest.approx(0.75)
    assert rig.device.record.slowest_write == done.took


def test_a_device_that_holds_something_else_is_named_with_its_value_and_stays_online() -> None:
    rig = online()
    write = rig.write("D2")
    rig.conclude(rig.transacted(), OLD)
    outcome = rig.outcomes[write]
    assert isinstance(outcome, Differs)
    assert str(outcome) == "acknowledged, but the device now holds 0"
    assert rig.device.health.consecutive_failures == 0


def test_a_refused_reading_back_does_not_make_the_write_refused() -> None:
    rig = online()
    write = rig.write("D2")
    rig.conclude(rig.transacted(), Sent(refused_back=NO))
    assert isinstance(rig.outcomes[write], Unclear)
    assert str(rig.outcomes[write]).startswith("acknowledged, but reading back was refused")
    assert rig.device.health.consecutive_failures == 0


def test_a_refused_write_is_counted_by_its_code() -> None:
    rig = online()
    rig.write("D4")
    rig.conclude(rig.transacted(), NO)
    assert rig.device.record.refusals == {"18": 1}


def test_a_write_is_not_repeated_after_it_expired() -> None:
    rig = online()
    write = rig.write("D3")
    rig.fail(rig.transacted())
    rig.now = write.expires
    rig.conclude(rig.transacted(), OK)
    assert isinstance(rig.outcomes[write], NoReply)


def test_a_write_that_failed_before_its_first_byte_was_not_sent() -> None:
    """The word of its bit could not be read, say: there is nothing to confirm."""
    rig = online()
    write = rig.write("D4")
    rig.conclude(rig.transacted(), NOISE, Traffic())
    settle(rig)
    assert isinstance(rig.outcomes[write], Busy)


def test_a_confirmation_asks_for_the_outstanding_request_with_a_new_token() -> None:
    rig = online()
    write = rig.write("D2")
    rig.fail(rig.transacted())
    confirm = rig.transacted()
    assert isinstance(confirm, Confirm)
    assert confirm.outstanding == write.tag.span
    assert confirm.token != rig.device.health.next_probe_token()


def test_writes_that_share_an_exchange_share_its_end() -> None:
    rig = online()
    writes = [rig.write("D0"), rig.write("D1")]
    job = rig.transacted()
    assert isinstance(job, WriteTogether)
    assert list(job.writes) == writes
    rig.conclude(job, OK)
    assert [ended(rig.outcomes[write]) for write in writes] == ["written", "written"]


def test_a_group_without_an_acknowledgement_is_unclear_for_each_and_is_not_sent_again() -> None:
    rig = online()
    writes = [rig.write("D0"), rig.write("D1")]
    rig.fail(rig.transacted())
    assert [ended(rig.outcomes[write]) for write in writes] == ["NoReply", "NoReply"]
    assert not rig.engine.schedule.requests.waiting


def test_writes_refused_together_before_any_was_done_are_sent_alone_in_their_order() -> None:
    rig = online()
    writes = [rig.write("D0"), rig.write("D1")]
    rig.conclude(rig.transacted(), DAMAGED)
    assert rig.outcomes == {}
    sent = list[Transacted]()
    while rig.engine.schedule.requests.waiting:
        job = rig.transacted()
        sent.append(job)
        rig.conclude(job, OK if isinstance(job, Write) else [0] * 6)
    assert [job for job in sent if isinstance(job, Write)] == writes
    assert all(write.refused is DAMAGED for write in writes)


@pytest.mark.parametrize(
    ("how", "after"),
    [
        ("expires", "waited 5.0 s for the line; not sent"),
        ("offline", "plc1 does not answer; nothing was sent"),
        ("lost", "line line: unplugged; not sent"),
        ("stops", "line line went down; not sent"),
        ("not sent", "not now"),
        ("fails before its first byte", "noise"),
    ],
)
def test_a_write_refused_together_that_is_not_sent_alone_was_refused(how: str, after: str) -> None:
    """ "Nothing was sent" is not the end of what was sent once."""
    rig = online()
    writes = [rig.write("D0"), rig.write("D1")]
    rig.conclude(rig.transacted(), DAMAGED)
    match how:
        case "expires":
            rig.now += WRITE_EXPIRY
            rig.note(rig.engine.expire(rig.now, rig.time))
        case "lost":
            rig.note(rig.engine.lost(LOST, rig.now, rig.time))
        case "stops":
            rig.note(rig.engine.stopped(rig.now))
        case "offline":
            while not rig.outcomes:
                rig.fail(rig.transacted())
        case _:
            refused: dict[type[Transacted], tuple[Result, Traffic | None]] = {
                Write: (Busy("not now"), None) if how == "not sent" else (NOISE, Traffic()),
                Settle: (Settled(None), None),
                Probe: (Resynced(1), None),
            }
            while len(rig.outcomes) < len(writes):
                job = rig.transacted()
                rig.conclude(job, *refused.get(type(job), ([0] * 6, None)))
    for write in writes:
        outcome = rig.outcomes[write]
        assert isinstance(outcome, Refused)
        assert (outcome.code, outcome.unexecuted) == (DAMAGED.code, True)
        assert str(outcome) == f"{DAMAGED}; after that: {after}"


@pytest.mark.parametrize(
    ("joint", "held", "outcomes"),
    [
        (NO, ([7], [7]), "verified verified"),
        (NO, ([7], [0]), "verified Unclear"),  # the program may have cleared the second again
        (NO_ADDRESS, ([7], NO_ADDRESS), "verified Refused"),
        (NO_ADDRESS, ([0], NO_ADDRESS), "Unclear Refused"),
        (NO, ([7], NO_ADDRESS), "verified Unclear"),
        (NO_ADDRESS, (None, NO), "Unclear Unclear"),
        (NO_ADDRESS, GONE, "Unclear Unclear"),
        (NO_ADDRESS, LOST, "Unclear Unclear"),
    ],
)
def test_writes_refused_together_perhaps_in_part_are_read_back_and_never_sent_again(
    joint: Refused, held: Any, outcomes: str
) -> None:
    rig = online()
    writes = [rig.write("D0"), rig.write("D1")]
    rig.conclude(rig.transacted(), joint)
    job = rig.transacted()
    assert isinstance(job, ReadBack)
    rig.conclude(job, HeldTogether(held) if isinstance(held, tuple) else held)
    if held is GONE:
        settle(rig)
    if held is LOST:
        rig.note(rig.engine.lost(LOST, rig.now, rig.time))
    assert " ".join(ended(rig.outcomes[write]) for write in writes) == outcomes
    assert not rig.engine.schedule.requests.waiting


def test_a_known_bad_address_is_written_alone() -> None:
    rig = online()
    block = rig.device.blocks[0]
    rig.device.bad_addresses.bad[Span("D", 1, 1)] = BadRange(Span("D", 1, 1), 0, "06", block.tags)
    writes = [rig.write("D0"), rig.write("D1")]
    assert rig.transacted() is writes[0]


@pytest.mark.parametrize(
    ("result", "outcome"),
    [("acknowledged", "obeyed"), (NO, "Refused"), (NOISE, "Garbled")],
)
def test_a_command_has_one_outcome_and_is_never_repeated(result: Result, outcome: str) -> None:
    rig = online()
    command = rig.command()
    rig.conclude(rig.transacted(), result, REPLIED if result is NO else None)
    if isinstance(result, Unclear):
        settle(rig)
    assert ended(rig.outcomes[command]) == outcome
    assert not isinstance(rig.next(), Command)


def test_after_a_write_without_acknowledgement_the_line_pauses() -> None:
    rig = Rig(broadcast_device())
    rig.write("holding:1")
    effects = rig.conclude(rig.transacted(), Sent(acknowledged=False))
    assert [effect for effect in effects if isinstance(effect, Pause)] == [Pause(BROADCAST_PAUSE)]


@pytest.mark.parametrize("text", ["D0", "D2", "D4"])
@pytest.mark.parametrize("settling", [False, True])
def test_the_loss_of_the_port_makes_a_sent_write_unclear_whatever_its_rule(
    text: str, settling: bool
) -> None:
    rig = online()
    write = rig.write(text)
    job = rig.transacted()
    if settling:
        rig.conclude(job, NOISE)
    rig.note(rig.engine.lost(LOST, rig.now, rig.time))
    assert str(rig.outcomes[write]) == "unplugged; it is unknown if the write was done"
    assert rig.device.health.outstanding == write.tag.span
    assert rig.device.health.needs_resync


def test_the_stop_of_the_gateway_makes_a_sent_command_unclear() -> None:
    rig = online()
    command = rig.command()
    assert rig.transacted() is command
    rig.note(rig.engine.stopped(rig.now))
    assert isinstance(rig.outcomes[command], Unclear)
    assert str(rig.outcomes[command]) == STOPPED


def test_the_written_tag_is_polled_next() -> None:
    rig = online()
    rig.conclude(rig.transacted(), [0] * 6)
    rig.write("D0")
    rig.conclude(rig.transacted(), OK)
    [poll] = rig.engine.schedule.polls(rig.device)
    assert rig.next() is poll.job
    assert poll.expedited


def test_a_write_to_a_device_that_went_offline_ends_offline_with_all_that_wait() -> None:
    rig = Rig()
    rig.bring(State.FAILING)
    first = rig.write("D2")
    job = rig.transacted()
    assert job is first
    waiting = rig.command()
    rig.fail(job)
    assert rig.device.state is State.OFFLINE
    assert ended(rig.outcomes[waiting]) == "Offline"
    confirm = rig.next()
    assert isinstance(confirm, Confirm)
    rig.conclude(confirm, HELD)
    assert ended(rig.outcomes[first]) == "verified"
    assert rig.device.health.online


def test_an_ambiguous_reply_to_a_probe_ends_no_request() -> None:
    rig = Rig()
    write = rig.write("D0")
    rig.conclude(rig.transacted(), Resynced(0))
    assert write not in rig.outcomes
    assert rig.transacted() is write
