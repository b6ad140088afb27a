"""A line on which no station replies any more is opened again, at growing times."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from gateway.engine.device.device import Device
from gateway.engine.jobs.jobs import Idle, Poll, Probe, Reopen, Resynced, Sent, Settle, Settled
from gateway.engine.jobs.requests import Write
from gateway.engine.results.line_silence import FIRST, LONGEST
from gateway.errors import Evidence, Garbled, Refused
from gateway.protocols.computer_link.codec import LinkCodec, Text
from tests.engine.rig import LOST, SILENCE, Rig, broadcast_device, link_device, tcp_device
from tests.sim.bench import WIRE
from tests.sim.plant import words


def silent_until_reopened(rig: Rig) -> float:
    """Lets every request fail. Returns the seconds until the port is opened again."""
    begun = rig.now
    while True:
        job = rig.next()
        match job:
            case Reopen():
                rig.note(rig.engine.lost(LOST, rig.now, rig.time))
                took = rig.now - begun
                rig.note(rig.engine.opened(rig.now))
                return took
            case Idle(until=until):
                rig.now = until
            case _:
                rig.fail(job)


def replied(rig: Rig) -> None:
    """Lets the next probe and the next poll succeed."""
    probe = rig.transacted()
    assert isinstance(probe, Probe)
    rig.conclude(probe, Resynced(1000))
    poll = rig.transacted()
    assert isinstance(poll, Poll)
    rig.conclude(poll, (0,) * poll.span.size)


def test_the_time_until_the_next_opening_doubles_until_a_station_replies() -> None:
    rig = Rig()
    replied(rig)
    took = [silent_until_reopened(rig) for _ in range(6)]
    assert [round(seconds / FIRST) for seconds in took] == [1, 2, 4, 6, 6, 6]
    assert round(took[-1]) == LONGEST
    replied(rig)
    assert round(silent_until_reopened(rig) / FIRST) == 1


def test_the_reason_says_how_long_no_station_replied() -> None:
    rig = Rig()
    while not isinstance(job := rig.next(), Reopen):
        if isinstance(job, Idle):
            rig.now = job.until
        else:
            rig.fail(job)
    assert job.why.startswith("no station has replied for 20 s (")
    assert rig.now == FIRST


def reopens(rig: Rig, seconds: float = 200.0) -> bool:
    """Runs the line: station 1 is silent, every other one replies."""
    while rig.now < seconds:
        job = rig.next()
        match job:
            case Reopen():
                return True
            case Idle(until=until):
                rig.now = until
            case _ if job.device is rig.device:
                rig.fail(job)
            case Probe():
                rig.conclude(job, Resynced(1))
            case Poll():
                rig.conclude(job, (0,) * job.span.size)
    return False


def test_one_station_that_replies_keeps_the_port_open() -> None:
    assert reopens(Rig(link_device(station=1)))
    assert not reopens(Rig(link_device(station=1), link_device(station=2)))


def test_a_station_that_is_rarely_read_is_read_before_the_port_is_opened_again() -> None:
    rare = link_device(station=2)
    rare = Device(
        replace(rare.settings, tags=tuple(words(0, 1, device="plc2", every=3600.0))), WIRE
    )
    rig = Rig(link_device(station=1), rare)
    assert not reopens(rig)
    assert rare.record.exchanges > 2


def test_an_error_reply_keeps_the_port_open_and_noise_does_not() -> None:
    for result, kept in (
        (Refused("no", code="06"), True),
        (Garbled("another station", evidence=Evidence.STATION), True),
        (Garbled("no frame", evidence=Evidence.NOISE), False),
        (Garbled("our own request", evidence=Evidence.ECHO), False),
    ):
        rig = Rig()
        while not isinstance(job := rig.next(), Reopen) and rig.now < 200.0:
            if isinstance(job, Idle):
                rig.now = job.until
                continue
            if isinstance(job, Settle):
                rig.conclude(job, Settled(None))
            else:
                rig.conclude(job, SILENCE if rig.now < 5.0 else result, took=0.5)
        assert isinstance(job, Reopen) is not kept, result


def test_a_late_reply_keeps_the_port_open() -> None:
    rig = Rig()
    while not isinstance(job := rig.next(), Reopen) and rig.now < 200.0:
        if isinstance(job, Idle):
            rig.now = job.until
        else:
            rig.fail(job, late=0.1)
    assert not isinstance(job, Reopen)


def test_bytes_count_as_life_only_where_a_device_sends_by_itself() -> None:
    rig = Rig()
    while not isinstance(job := rig.next(), Reopen) and rig.now < 200.0:
        rig.note(rig.engine.received(b"\x00", rig.now, rig.time))
        if isinstance(job, Idle):
            rig.now = job.until
        else:
            rig.fail(job)
    assert isinstance(job, Reopen)


@pytest.mark.parametrize(
    ("rig", "late"),
    [
        (lambda: Rig(link_device()), LinkCodec().encode(Text(1, "0000"))),
        (lambda: Rig(tcp_device()), bytes.fromhex("0007 0000 0003 01 83 0B")),
    ],
    ids=["computer-link", "modbus-tcp"],
)
def test_late_frames_outside_of_a_transaction_keep_the_port_open(
    rig: Callable[[], Rig], late: bytes
) -> None:
    """A server that works through its queue replies, although each reply is too late."""
    for arrives in (True, False):
        each, last = rig(), 0.0
        while not isinstance(job := each.next(), Reopen) and each.now < 200.0:
            if isinstance(job, Idle):
                each.now = job.until
                if arrives and each.now >= last + 3.0:
                    last = each.now
                    each.note(each.engine.received(late, each.now, each.time))
            elif isinstance(job, Settle):
                each.conclude(job, Settled(None))
            else:
                each.fail(job)
        assert isinstance(job, Reopen) is not arrives


def test_a_broadcast_that_was_sent_is_no_sign_of_life() -> None:
    """A line whose clients write to all stations every few seconds was never opened again."""
    rig = Rig(broadcast_device(), link_device())
    told = 0.0
    while not isinstance(job := rig.next(), Reopen) and rig.now < 200.0:
        if rig.now >= told + 3.0:
            told = rig.now
            rig.write("holding:1")
        if isinstance(job, Idle):
            rig.now = min(job.until, told + 3.0)
        elif isinstance(job, Write):
            rig.conclude(job, Sent(acknowledged=False))
        else:
            rig.fail(job)
    assert isinstance(job, Reopen)
