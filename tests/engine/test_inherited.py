"""Requests that an earlier process left in a device server, when the gateway starts."""

from gateway.engine.jobs.jobs import Poll, Probe, Resynced, Settle, Settled, Transacted
from gateway.protocols.driver import EVERY_REQUEST
from tests.engine.rig import SILENCE, Rig, link_device


def starting() -> Rig:
    rig = Rig(link_device(), link_device(station=2))
    rig.engine.inherits()
    return rig


def probe(rig: Rig) -> Probe:
    job = rig.transacted()
    assert isinstance(job, Probe)
    return job


def after(rig: Rig, first: Transacted, told_from: int) -> Transacted:
    rig.conclude(first, Resynced(told_from))
    return rig.transacted()


def test_the_first_reply_of_a_line_counts_only_after_a_quiet_wire() -> None:
    rig = starting()
    first = probe(rig)
    settle = after(rig, first, 1)
    assert isinstance(settle, Settle)
    assert not rig.device.health.online
    rig.conclude(settle, Settled(None))
    again = probe(rig)
    assert again.device is first.device
    assert again.again
    rig.conclude(again, Resynced(1))
    assert first.device.health.online
    other = next(job for _ in range(9) if isinstance(job := rig.transacted(), Probe))
    assert other.device is not first.device
    assert not isinstance(after(rig, other, 1), Settle)  # the wire was quiet for all of them


def test_a_reply_that_is_marked_counts_at_once() -> None:
    rig = starting()
    assert isinstance(after(rig, probe(rig), EVERY_REQUEST), Poll | Probe)
    assert rig.device.health.online


def test_a_late_reply_does_not_replace_the_quiet_wire() -> None:
    rig = starting()
    while (first := probe(rig)).timeout is not None:  # short probes first
        rig.conclude(first, SILENCE)
        rig.conclude(rig.transacted(), Settled(None))
    rig.conclude(first, SILENCE)
    rig.conclude(rig.transacted(), Settled(0.1))
    assert isinstance(after(rig, probe(rig), 1), Settle)


def test_a_wire_that_is_never_quiet_does_not_keep_the_devices_offline() -> None:
    """Another master speaks on it."""
    rig = starting()
    settle = after(rig, probe(rig), 1)
    rig.conclude(settle, Settled(None, quiet=False))
    while not isinstance(job := rig.transacted(), Probe):
        rig.conclude(job, Settled(None))
    after(rig, job, 1)
    assert rig.device.health.online or rig.devices[1].health.online
