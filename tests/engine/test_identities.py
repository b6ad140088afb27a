"""Identity: a device that is not the one of the file has no good values, and takes no writes."""

from dataclasses import replace

import pytest

from gateway.engine.device.device import Device
from gateway.engine.device.health import State
from gateway.engine.device.identity import RECHECK, SILENT_FOR, SILENT_TRIES, Verdict
from gateway.engine.jobs.jobs import (
    Identified,
    Identify,
    Poll,
    Probe,
    Resynced,
    Sent,
    Settle,
    Settled,
)
from gateway.engine.jobs.requests import Write
from gateway.errors import Refusal, Refused, WrongDevice
from gateway.protocols.modbus import ModbusRtu
from gateway.tags import Quality, Reason, WriteRule
from tests.engine.rig import LOST, Rig
from tests.sim.bench import WIRE
from tests.sim.plant import made_device, make_tag

SELF, OTHER = Identified({"vendor": ("ABB",)}), Identified({"vendor": ("Siemens",)})
LACKS = Refused("no such function", code="01", unexecuted=True)
BUSY = Refused("busy", code="06", refusal=Refusal.BUSY, unexecuted=True)


def meter(station: int = 1, *, retries: int = 1, every: float = 1.0) -> Device:
    driver = ModbusRtu(station=station)
    timing = replace(driver.timing, reply_timeout=0.5, retries=retries)
    name = f"meter{station}"
    tags = [make_tag("holding:1", driver, write=WriteRule(), device=name, every=every)]
    identity = {"vendor": "ABB"}
    return made_device(name, driver, WIRE, timing, tags, identity=identity)


def asked(rig: Rig) -> Identify:
    """The next question; polls, probes and silences before it end well."""
    for _ in range(100):
        job = rig.transacted()
        match job:
            case Identify():
                return job
            case Probe():
                rig.conclude(job, Resynced(99))
            case Settle():
                rig.conclude(job, Settled(None))
            case Poll():
                rig.conclude(job, [7])
    raise AssertionError("it is never asked")


def is_good(rig: Rig) -> bool:
    return rig.samples[-1].quality is Quality.GOOD


@pytest.fixture
def rig() -> Rig:
    return Rig(meter())


@pytest.fixture
def known(rig: Rig) -> Rig:
    """It told who it is, and was polled."""
    rig.conclude(asked(rig), SELF)
    poll = rig.transacted()
    assert isinstance(poll, Poll)
    rig.conclude(poll, [7])
    assert is_good(rig)
    return rig


def test_it_is_asked_before_the_first_value_and_then_in_each_cycle_of_its_polls(rig: Rig) -> None:
    rig.conclude(asked(rig), SELF)
    assert rig.samples == []
    begun = rig.now
    again = asked(rig)
    assert is_good(rig)
    cycle = rig.device.blocks[0].every
    assert cycle <= rig.now - begun < 1.2 * cycle
    rig.conclude(again, SELF)


def test_on_a_line_without_free_time_it_is_asked_rarely() -> None:
    rig = Rig(meter(every=0.01))
    assert rig.device.load > 1
    rig.conclude(asked(rig), SELF)
    begun, polls = rig.now, len(rig.samples)
    while not isinstance(job := rig.transacted(), Identify):
        rig.conclude(job, [len(rig.samples)])
    assert rig.now - begun >= RECHECK
    assert len(rig.samples) > polls + 100


def test_another_device_has_no_good_values_and_takes_no_writes(known: Rig) -> None:
    write = known.write("holding:1")
    known.engine.schedule.requests.withdraw()
    question = asked(known)
    waiting = known.write("holding:1")
    known.conclude(question, OTHER)
    bad = known.samples[-1]
    assert (bad.quality, bad.reason) == (Quality.BAD, Reason.WRONG_DEVICE)
    assert bad.detail == known.device.diagnosis()
    assert "tells vendor Siemens; the file says vendor ABB" in bad.detail
    assert isinstance(known.outcomes[waiting], WrongDevice)
    assert isinstance(known.outcomes[known.write("holding:1")], WrongDevice)
    assert write not in known.outcomes
    before = len(known.samples)
    known.conclude(asked(known), OTHER)  # nothing else is sent to it
    assert len(known.samples) == before


def test_the_right_device_is_polled_and_written_again(known: Rig) -> None:
    known.conclude(asked(known), OTHER)
    known.conclude(asked(known), SELF)
    assert known.device.diagnosis() == ""
    write = known.write("holding:1")
    jobs = {type(known.transacted())}
    assert jobs <= {Poll, Write}
    assert write not in known.outcomes


@pytest.mark.parametrize("cause", ["silent once", "offline", "line lost"])
def test_it_is_asked_again_before_the_next_value(known: Rig, cause: str) -> None:
    if cause == "line lost":
        known.note(known.engine.lost(LOST, known.now, known.time))
        known.note(known.engine.opened(known.now))
    else:
        for _ in range(1 if cause == "silent once" else 3):
            job = known.transacted()
            known.fail(job)
        assert known.device.state is (State.FAILING if cause == "silent once" else State.OFFLINE)
    while isinstance(job := known.transacted(), Probe):
        known.conclude(job, Resynced(99))
    assert isinstance(job, Identify)


def test_a_device_without_the_function_is_used_and_its_status_says_so(rig: Rig) -> None:
    """Also while it is asked again and again."""
    for _ in range(3):
        rig.conclude(asked(rig), LACKS)
    poll = rig.transacted()
    assert isinstance(poll, Poll)
    rig.conclude(poll, [7])
    assert is_good(rig)
    assert "cannot tell its identity" in rig.device.diagnosis()
    warned = [event.event for event in rig.logged if event.level == "warning"]
    assert warned == ["identity doubtful"]


def test_one_that_told_it_before_and_refuses_it_now_is_another(known: Rig) -> None:
    known.conclude(asked(known), LACKS)
    assert known.samples[-1].reason is Reason.WRONG_DEVICE
    known.conclude(asked(known), SELF)  # there is a way back
    assert known.device.identity is not None
    assert known.device.identity.is_usable


def test_a_device_that_is_silent_about_it_is_used_and_asked_again_after_an_hour(rig: Rig) -> None:
    for _ in range(SILENT_TRIES):
        rig.fail(asked(rig))
    begun = rig.now
    while isinstance(job := rig.transacted(), Probe):
        rig.conclude(job, Resynced(99))
    assert isinstance(job, Poll)
    rig.conclude(job, [7])
    assert is_good(rig)
    assert "is silent about its identity" in rig.device.diagnosis()
    rig.note(rig.engine.lost(LOST, rig.now, rig.time))
    rig.note(rig.engine.opened(rig.now))
    while isinstance(job := rig.transacted(), Probe):
        rig.conclude(job, Resynced(99))
    assert isinstance(job, Poll)  # no time-outs at each return
    rig.conclude(job, [7])
    rig.now = begun + SILENT_FOR
    rig.engine.expire(rig.now, rig.time)
    rig.conclude(asked(rig), SELF)
    assert rig.device.diagnosis() == ""


def test_one_that_told_it_before_and_is_silent_now_is_not_read(known: Rig) -> None:
    for _ in range(SILENT_TRIES + 2):
        known.fail(asked(known))
    before = len([one for one in known.samples if one.quality is Quality.GOOD])
    assert isinstance(known.outcomes[known.write("holding:1")], WrongDevice)
    known.conclude(asked(known), SELF)
    assert len([one for one in known.samples if one.quality is Quality.GOOD]) == before


def test_its_questions_hold_up_no_other_device() -> None:
    rig = Rig(meter(1), meter(2))
    for number in (1, 1, 2, 2):
        question = asked(rig)
        other = number == 1 and question.device is rig.devices[0]
        rig.conclude(question, OTHER if other else SELF)
    polled = 0
    for _ in range(30):
        job = rig.transacted()
        if isinstance(job, Poll):
            polled += job.device is rig.devices[1]
            rig.conclude(job, [7])
        elif isinstance(job, Identify):
            rig.conclude(job, OTHER if job.device is rig.devices[0] else SELF)
    assert polled > 10


def test_a_device_that_is_only_written_is_asked_before_its_first_write() -> None:
    """`tags: {command: {address: "holding:8193", write: true, poll: false}}`"""
    driver = ModbusRtu(station=4)
    tags = [make_tag("holding:8193", driver, write=WriteRule(polled=False))]
    identity = {"vendor": "ABB"}
    rig = Rig(made_device("drive", driver, WIRE, driver.timing, tags, identity=identity))
    first = rig.write("holding:8193")
    rig.conclude(asked(rig), SELF)
    assert rig.transacted() is first
    rig.conclude(first, Sent())
    rig.conclude(asked(rig), OTHER)
    assert isinstance(rig.outcomes[rig.write("holding:8193")], WrongDevice)


def test_a_busy_device_is_asked_again_soon(rig: Rig) -> None:
    rig.conclude(asked(rig), BUSY)
    assert rig.samples == []
    rig.conclude(asked(rig), SELF)
    assert rig.now < 2.0


def test_with_no_retries_silence_about_it_is_no_silence_of_the_device() -> None:
    rig = Rig(meter(retries=0))
    rig.fail(asked(rig))
    assert rig.device.state is not State.OFFLINE


def test_a_reload_with_the_same_identity_keeps_what_was_told(known: Rig) -> None:
    old = known.device
    new = old.successor(replace(old.settings, tags=old.settings.tags), old.bad_addresses.known())
    new.take_over(old)
    assert new.identity is old.identity
    changed = replace(old.settings, identity={"vendor": "LS"})
    other = old.successor(changed, old.bad_addresses.known())
    other.take_over(old)
    assert other.identity is not None
    assert other.identity.verdict is Verdict.UNKNOWN
