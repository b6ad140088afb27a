"""Changed devices are taken over between two jobs; what was learned and read goes on."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

from gateway.engine.device.changes import Changes
from gateway.engine.device.device import Device
from gateway.engine.device.device_settings import DeviceSettings
from gateway.engine.device.health import State
from gateway.engine.engine import Engine
from gateway.engine.jobs.jobs import Idle, Poll, Probe, Resynced, Settle, Settled
from gateway.errors import Busy, Refusal, Refused
from gateway.tags import Quality, Reason, Tag
from tests.engine.rig import Rig, ended, link_device, tcp_device
from tests.sim.plant import make_tag


def change(rig: Rig, old: Device, renewed: dict[Tag, Tag] | None = None, **settings: Any) -> Device:
    """Replaces a device of the rig by one with these settings."""
    new = old.successor(replace(old.settings, **settings), old.bad_addresses.known())
    new.plan()
    changes = Changes(replaced=[(old, new)], renewed=renewed or {})
    rig.note(rig.engine.change(changes, rig.now))
    rig.device = new
    return new


def renewed(settings: DeviceSettings, every: float) -> dict[Tag, Tag]:
    driver = settings.driver
    return {tag: make_tag(tag.text, driver, write=tag.write, every=every) for tag in settings.tags}


def read_once(rig: Rig) -> Poll:
    rig.bring(State.ONLINE)
    poll = rig.transacted()
    assert isinstance(poll, Poll)
    rig.conclude(poll, [0] * len(poll.block.tags))
    return poll


def test_a_value_that_goes_on_keeps_its_age_and_turns_stale_in_time() -> None:
    rig = Rig()
    read_once(rig)
    read = rig.now
    known = renewed(rig.device.settings, 1.0)
    rig.now += 0.5
    new = change(rig, rig.device, known, tags=tuple(known.values()))
    assert [poll.reads.at for poll in rig.engine.schedule.polls(new)] == [read]
    rig.now = rig.engine.deadline
    rig.note(rig.engine.expire(rig.now, rig.time))
    while not any(sample.quality is Quality.BAD for sample in rig.samples):
        rig.now = rig.engine.deadline
        rig.note(rig.engine.expire(rig.now, rig.time))
    assert rig.samples[-1].reason is Reason.OVERDUE
    assert rig.samples[-1].tag in known.values()
    assert rig.now - read < 5.0


def test_the_next_poll_comes_at_the_new_interval() -> None:
    rig = Rig()
    for _ in range(4):
        _polled(rig)
    known = renewed(rig.device.settings, 0.1)
    change(rig, rig.device, known, tags=tuple(known.values()))
    begun = [_polled(rig) for _ in range(20)]
    assert all(0.05 < b - a < 0.2 for a, b in pairwise(begun))


def _polled(rig: Rig) -> float:
    job = rig.transacted()
    while isinstance(job, Probe):
        rig.conclude(job, Resynced(1))
        job = rig.transacted()
    assert isinstance(job, Poll)
    at = rig.now
    rig.conclude(job, [0] * len(job.block.tags))
    return at


def test_a_changed_device_has_its_state_and_its_outstanding_request() -> None:
    rig = Rig()
    read_once(rig)
    poll = rig.transacted()
    assert isinstance(poll, Poll)
    rig.fail(poll)
    old = rig.device
    assert old.health.needs_resync
    new = change(rig, old, late_guard=0.7)
    assert new.state is State.FAILING
    probe = rig.transacted()
    assert isinstance(probe, Probe)
    assert (probe.device, probe.outstanding) == (new, poll.block.span)


def test_a_resync_after_a_change_is_not_told_from_those_before() -> None:
    rig = Rig()
    rig.bring(State.OFFLINE)
    for _ in range(3):
        rig.fail(rig.transacted())
    change(rig, rig.device, tags=rig.device.tags[:2])
    while isinstance(probe := rig.next(), Idle):
        rig.now = probe.until
    assert isinstance(probe, Probe)
    assert probe.token == 2  # none of the resyncs before counts as another one
    rig.conclude(probe, Resynced(0))
    assert isinstance(rig.next(), Settle)


def test_bad_addresses_stay_known() -> None:
    rig = Rig(tcp_device(blocks=2))
    rig.bring(State.ONLINE)
    poll = rig.transacted()
    assert isinstance(poll, Poll)
    refused = Refused("no", code="02", refusal=Refusal.ADDRESS)
    for other in (*rig.engine.alongside(poll, rig.now), poll):
        rig.conclude(other, refused)
    assert len(rig.device.bad_addresses.bad) == 2
    new = change(rig, rig.device, late_guard=0.7)
    assert len(new.bad_addresses.bad) == 2


def test_a_search_for_silent_addresses_ends_although_the_file_is_read_again_within_it() -> None:
    """Each round began with the whole block, and three time-outs (`hostile` seed 2700044)."""
    rig = Rig(link_device(retries=1))
    rig.bring(State.ONLINE)
    assert len(rig.device.blocks) == 1
    failures = 0
    for _ in range(10):
        for _ in range(3):
            match rig.transacted():
                case Probe() as job:
                    rig.conclude(job, Resynced(1000))
                case Poll(span=span) as job if span.start < 3 < span.start + span.size:
                    failures += 1
                    rig.fail(job)
                case Poll() as job:
                    rig.conclude(job, [0] * job.span.size)
        change(rig, rig.device, late_guard=rig.device.settings.late_guard * 1.01)
    assert failures == 4  # three until the first search, one until the second
    assert len(rig.device.blocks) == 2


def test_waiting_requests_to_a_changed_device_are_refused_and_others_are_not() -> None:
    rig = Rig(link_device(), link_device(station=2))
    first = rig.write("D0")
    rig.device = rig.devices[1]
    second = rig.write("D0")
    change(rig, rig.devices[0], late_guard=0.7)
    assert isinstance(rig.outcomes[first], Busy)
    assert "not sent" in str(rig.outcomes[first])
    assert second not in rig.outcomes


def test_devices_come_and_go_on_one_line() -> None:
    rig = Rig()
    read_once(rig)
    first, second = rig.device, link_device(station=2)
    rig.note(rig.engine.change(Changes(added=[second]), rig.now))
    probe = rig.transacted()
    assert isinstance(probe, Probe)
    assert probe.device is second
    rig.conclude(probe, Resynced(1))
    settle = rig.next()  # its station may be that of a device before
    assert isinstance(settle, Settle)
    rig.conclude(settle, Settled(None))
    rig.conclude(rig.transacted(), Resynced(1))
    asked = {_device_of(rig) for _ in range(6)}
    assert asked == {first, second}
    rig.note(rig.engine.change(Changes(removed=[first]), rig.now))
    assert {_device_of(rig) for _ in range(6)} == {second}
    rig.note(rig.engine.change(Changes(removed=[second]), rig.now))
    job = rig.next()
    assert isinstance(job, Idle)
    assert job.until == float("inf")


def _device_of(rig: Rig) -> Device:
    """The device of the next poll. An added one may get late replies: it settles and resyncs."""
    job = rig.transacted()
    while isinstance(job, Settle | Probe):
        rig.conclude(job, Settled(late=None) if isinstance(job, Settle) else Resynced(1))
        job = rig.transacted()
    assert isinstance(job, Poll)
    rig.conclude(job, [0] * len(job.block.tags))
    return job.device


def test_a_line_that_is_closed_takes_changes_over_too() -> None:
    device = link_device()
    rig = Rig(device)
    rig.note(rig.engine.stopped(rig.now))
    change(rig, device, late_guard=0.7)
    assert rig.engine.deadline == float("inf")
    write = rig.write("D0")
    assert ended(rig.outcomes[write]) == "LineDown"
    assert isinstance(rig.engine, Engine)
