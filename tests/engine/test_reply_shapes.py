"""Requests in quick succession expect replies of different shapes."""

from dataclasses import replace

import pytest

from gateway.engine.device.device import Device
from gateway.engine.device.health import State
from gateway.engine.device.long_writes import LongWrite
from gateway.engine.device.longer_reads import KNOWN_FOR, MOST_FAILED, MOST_WARY, LongerReads
from gateway.engine.device.reply_shapes import (
    MARK_FIRST,
    MARK_LONGEST,
    QUIET,
    WARY,
    WARY_FOR,
    ReplyShapes,
    reply_shapes,
)
from gateway.engine.jobs.jobs import Idle, Poll, Probe, Resynced, Sent
from gateway.engine.jobs.requests import Write
from gateway.errors import Refusal, Refused
from gateway.planning.bad_addresses import BadAddresses
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.computer_link.codec import Ack, Enquiry, Text
from gateway.protocols.driver import AnyDriver, Span
from gateway.protocols.modbus import ModbusAscii, ModbusRtu, ModbusTcp
from gateway.protocols.modbus.frame import Frame
from gateway.protocols.vigor import Vigor
from gateway.protocols.vigor.codec import READ, Reply, Request
from gateway.tags import Quality, Reason, WriteRule
from tests.engine.rig import REPLIED, Rig, kinds, link_device, tcp_device
from tests.sim.plant import device, make_tag, words

SERIAL = [ModbusRtu(station=1), ModbusAscii(station=1), Vigor(station=1), ComputerLink(station=1)]


def single(**settings: object) -> Device:
    return device(words(100, 10), **settings)  # type: ignore[arg-type]


def shapes_of(dev: Device) -> ReplyShapes:
    assert dev.shapes is not None
    return dev.shapes


def read(shapes: ReplyShapes, dev: Device, now: float) -> Span:
    """One poll of the first block, which ends at once."""
    span = shapes.polled(dev.blocks[0], now)
    shapes.at = now
    return span


def test_reads_in_quick_succession_differ_in_length() -> None:
    dev = single()
    sizes = [read(shapes_of(dev), dev, 0.02 * n).size for n in range(6)]
    assert sizes == [10, 11, 12, 10, 11, 12]


def test_after_a_quiet_time_the_block_is_read_alone() -> None:
    dev = single()
    assert [read(shapes_of(dev), dev, QUIET * n).size for n in range(4)] == [10] * 4


def test_the_longer_span_lies_among_the_tags_where_there_are_some() -> None:
    dev = device([*words(100, 10), *words(500, 10)])
    second = next(block for block in dev.blocks if block.span.start == 500)
    shapes = shapes_of(dev)
    spans = []
    for n in range(3):
        spans.append(shapes.polled(second, 0.02 * n))
        shapes.at = 0.02 * n
    assert spans == [Span("D", 500, 10), Span("D", 499, 11), Span("D", 498, 12)]


def test_a_longer_span_that_was_refused_is_not_read_again() -> None:
    dev = single()
    shapes = shapes_of(dev)
    read(shapes, dev, 0.0)
    span = dev.blocks[0].span
    after = read(shapes, dev, 0.02)
    assert after.start == span.start
    shapes.longer.refused(span, after, 0.02)
    before = read(shapes, dev, 0.04)
    assert before.start + before.size == span.start + span.size  # those before it may exist
    shapes.longer.refused(span, span._replace(start=span.start - 1, size=11), 0.04)
    assert read(shapes, dev, 0.06) == span


def test_a_longer_span_is_read_again_if_the_block_alone_was_refused_too() -> None:
    """A device that refuses everything for a second kept one shape for ever."""
    dev = single()
    shapes, span = shapes_of(dev), dev.blocks[0].span
    read(shapes, dev, 0.0)
    longer = read(shapes, dev, 0.02)
    shapes.longer.refused(span, longer, 0.02)
    shapes.longer.refused_alone(span, 0.03)  # it was read meanwhile: a new refusal
    assert longer not in [read for read, _ in shapes.longer.choices(span)]
    shapes.longer.refused_alone(span, 0.01)
    assert longer in [read for read, _ in shapes.longer.choices(span)]


def test_a_device_that_comes_back_has_the_addresses_that_it_had_for_some_time() -> None:
    dev = single()
    shapes, span = shapes_of(dev), dev.blocks[0].span
    longer = read(shapes, dev, 0.0), read(shapes, dev, 0.02)
    shapes.longer.refused(span, longer[1], 1.0)
    shapes.longer.restart(KNOWN_FOR)
    assert longer[1] not in [read for read, _ in shapes.longer.choices(span)]
    shapes.longer.restart(KNOWN_FOR + 1.0)
    assert longer[1] in [read for read, _ in shapes.longer.choices(span)]


def test_an_acknowledgement_may_be_repeated_later_by_a_device_that_answers_twice() -> None:
    """A second station replied 0.3 s late, and acknowledged the next write."""
    shapes = shapes_of(single())
    shapes.sent("written", 5.0)
    shapes.acknowledged(5.0)
    assert not shapes.may_be_extra("written", 5.3)
    shapes.at = 5.0
    shapes.extra_arrived(5.0)
    assert shapes.may_be_extra("written", 5.3)
    assert shapes.may_be_extra("written", 6.6)  # any reply may be another one, for ten minutes
    shapes.marked(5.0 + WARY_FOR)
    assert not shapes.may_be_extra("written", 6.6 + WARY_FOR)


def test_a_longer_span_without_replies_is_given_up() -> None:
    dev = single()
    shapes, span = shapes_of(dev), dev.blocks[0].span
    longer = span._replace(size=11)
    read(shapes, dev, 0.0)
    for _ in range(MOST_FAILED - 1):
        shapes.longer.unanswered(span, longer, 0.0)
        assert read(shapes, dev, 0.01) == span  # alone, once
    shapes.longer.answered(span, longer)
    for _ in range(MOST_FAILED - 1):
        shapes.longer.unanswered(span, longer, 0.0)
        read(shapes, dev, 0.01)
    assert read(shapes, dev, 0.02) == longer
    shapes.longer.unanswered(span, longer, 0.03)
    assert read(shapes, dev, 0.04) == span
    assert read(shapes, dev, 0.06).start < span.start  # the other side may exist
    shapes.longer.restart(0.07)  # it was online before, and knew the same addresses
    assert longer not in [read(shapes, dev, now) for now in (0.08, 0.1)]
    shapes.longer.restart(KNOWN_FOR + 0.1)
    assert longer in [read(shapes, dev, now) for now in (0.08, 0.1)]


def test_a_reply_to_a_shorter_read_does_not_count_for_a_longer_one_without_replies() -> None:
    """Nine coils had a reply, 17 had none: every third read was without one, for ten minutes."""
    dev = single()
    shapes, span = shapes_of(dev), dev.blocks[0].span
    shapes.doubt(0.0)
    longest = span._replace(size=14)
    for _ in range(MOST_FAILED):
        shapes.longer.unanswered(span, longest, 0.0)
        shapes.longer.answered(span, span._replace(size=12))
    read_now = {read(shapes, dev, 0.01 * n) for n in range(20)}
    assert span._replace(size=13) in read_now
    assert longest not in read_now


@pytest.mark.parametrize("driver", SERIAL, ids=lambda driver: driver.protocol)
def test_reads_of_the_same_shape_have_the_same_reply_length(driver: AnyDriver) -> None:
    area = "holding" if driver.protocol.startswith("modbus") else "D"
    found = {driver.reply_shape(Span(area, 0, size)): size for size in range(1, 20)}  # type: ignore[attr-defined]
    assert len(found) == 19
    assert driver.reply_shape(Span(area, 7, 3)) == driver.reply_shape(Span(area, 0, 3))  # type: ignore[attr-defined]


def test_after_an_extra_reply_more_shapes_are_used_for_longer() -> None:
    dev = single()
    shapes = shapes_of(dev)
    shapes.extra_arrived(0.0)
    spans = {read(shapes, dev, 0.9 * WARY / MOST_WARY * n) for n in range(MOST_WARY)}
    assert len(spans) == MOST_WARY
    read(shapes, dev, WARY_FOR)
    assert [read(shapes, dev, WARY_FOR + QUIET * n).size for n in (1, 2)] == [10, 10]


def test_writes_of_many_values_are_not_remembered_one_by_one() -> None:
    driver = ModbusRtu(station=1)
    tag = make_tag("holding:5", driver, type="uint16", write=WriteRule())
    shapes = reply_shapes(driver, [tag], BadAddresses(driver.cost))
    assert shapes is not None
    for value in range(100):
        shapes.written(tag.span, [value], False, float(value))
    assert len(shapes._used) == 0


def test_numbered_replies_need_no_shapes() -> None:
    assert reply_shapes(ModbusTcp(station=1), [], tcp_device().bad_addresses) is None
    assert tcp_device().shapes is None


def test_only_a_reply_of_the_station_is_an_extra_reply() -> None:
    vigor, link, modbus = Vigor(station=1), ComputerLink(station=1), ModbusRtu(station=1)
    assert vigor.is_reply(Reply(1, READ, "00", b"12"))
    assert not vigor.is_reply(Reply(2, READ, "00", b"12"))
    assert not vigor.is_reply(Request(1, READ, b""))
    assert link.is_reply(Text(1, "0007"))
    assert link.is_reply(Ack(1))
    assert not link.is_reply(Text(1, "0007", "FE"))  # on-demand data
    assert not link.is_reply(Enquiry(1, "WR", "D000001"))
    assert modbus.is_reply(Frame(1, b"\x03\x02\x00\x07"))
    assert not modbus.is_reply(Frame(2, b"\x03\x02\x00\x07"))


# In the engine


def polling(*devices: Device) -> tuple[Rig, Poll]:
    """An engine that has just read the first block."""
    rig = Rig(*devices)
    rig.bring(State.ONLINE)
    poll = rig.transacted()
    assert isinstance(poll, Poll)
    return rig, poll


def test_an_extra_reply_asks_for_a_resync_and_takes_back_the_last_values() -> None:
    rig, poll = polling(link_device())
    rig.conclude(poll, [0] * 6)
    assert rig.samples[-1].quality is Quality.GOOD
    rig.now += 0.01
    rig.note(rig.engine.unmatched(rig.device, Ack(1), rig.now, rig.time))
    assert rig.samples[-1].reason is Reason.GARBLED
    assert "Answers twice" in rig.device.diagnosis()
    assert [event.event for event in rig.logged][-1] == "device answers twice"
    probe = rig.next()
    assert isinstance(probe, Probe)
    rig.conclude(probe, Resynced(0xFFFF))
    again = rig.next()  # at once
    assert isinstance(again, Poll)
    assert again.block is poll.block


def test_values_before_a_quiet_time_stay_good_after_an_extra_reply() -> None:
    rig, poll = polling(link_device())
    rig.conclude(poll, [0] * 6)
    rig.now += 1.1 * QUIET
    rig.note(rig.engine.unmatched(rig.device, Ack(1), rig.now, rig.time))
    assert rig.samples[-1].quality is Quality.GOOD
    assert isinstance(rig.transacted(), Probe)


def test_a_reply_to_the_request_in_flight_does_not_end_the_need_of_a_resync() -> None:
    rig, poll = polling(link_device())
    rig.note(rig.engine.unmatched(rig.device, Ack(1), rig.now, rig.time))
    rig.conclude(poll, [0] * 6)
    assert isinstance(rig.transacted(), Probe)


def test_the_echo_of_the_request_is_no_extra_reply() -> None:
    rig, poll = polling(link_device())
    rig.note(rig.engine.unmatched(rig.device, Ack(1), rig.now, rig.time, echo=True))
    assert rig.device.diagnosis() == ""
    assert not rig.device.health.needs_resync
    rig.conclude(poll, [0] * 6)


def test_a_reply_to_an_older_request_is_no_extra_reply() -> None:
    rig = Rig(link_device())
    rig.note(rig.engine.unmatched(rig.device, Ack(1), rig.now, rig.time))
    assert rig.device.diagnosis() == ""


def test_a_refused_longer_read_is_repeated_without_it() -> None:
    rig, poll = polling(link_device())
    rig.conclude(poll, [0] * 6)
    poll = rig.transacted()  # type: ignore[assignment]
    rig.device.shapes.at = rig.now  # type: ignore[union-attr]
    rig.conclude(poll, [0] * 6)
    again = rig.transacted()
    assert isinstance(again, Poll)


def test_the_second_of_two_writes_is_followed_by_a_resync() -> None:
    rig, poll = polling(link_device())
    rig.conclude(poll, [0] * 6)
    first, tokens = rig.write("D0"), []
    assert rig.next() is first
    tokens.append(first.resyncs)
    rig.conclude(first, Sent(), REPLIED)
    second = rig.write("D0", 8)
    job = rig.next()
    if isinstance(job, Poll):
        rig.conclude(job, [0] * 6)
        job = rig.next()
    assert job is second
    assert (first.resyncs.before, first.resyncs.after) == (None, None)
    assert second.resyncs.before is None
    assert second.resyncs.after is not None


def test_a_write_after_a_refusal_is_followed_by_a_resync() -> None:
    rig, poll = polling(link_device())
    rig.conclude(poll, Refused("NAK 06", code="06", refusal=Refusal.OTHER), REPLIED)
    write = rig.write("D0")
    job = rig.next()
    assert isinstance(job, Write)
    assert write.resyncs.after is not None


def test_a_broadcast_after_a_write_needs_no_resync_and_is_followed_by_a_pause() -> None:
    rig, poll = polling(link_device())
    rig.conclude(poll, [0] * 6)
    write = rig.write("D0")
    assert rig.next() is write
    rig.conclude(write, Sent(), REPLIED)
    broadcast = rig.command("global", "on")
    job = rig.next()
    if isinstance(job, Poll):
        rig.conclude(job, [0] * 6)
        job = rig.next()
    assert job is broadcast
    assert broadcast.resyncs.before is None
    assert "pause" in kinds(rig.conclude(broadcast, "sent to all stations", REPLIED))


def test_on_a_wire_that_is_never_quiet_a_resync_shows_the_order_from_time_to_time() -> None:
    rig, poll = polling(link_device())
    rig.conclude(poll, [0] * 6)
    marks = []
    last = rig.now
    while rig.now < 3 * MARK_LONGEST:
        job = rig.next()
        if isinstance(job, Probe):
            marks.append(rig.now - last)
            last = rig.now
            rig.conclude(job, Resynced(0xFFFF))
            continue
        if not isinstance(job, Poll):
            rig.now += 0.9 * QUIET
            poll.device.shapes.at = rig.now  # type: ignore[union-attr]  # another transaction
            continue
        rig.conclude(job, [0] * 6, took=0.1)
    assert marks[0] >= MARK_FIRST
    assert marks[-1] >= MARK_LONGEST
    assert marks == sorted(marks)


def test_a_device_that_is_silent_about_other_addresses_stays_online_with_no_retries() -> None:
    """A longer read without a reply made it offline, again and again."""
    rig = Rig(device(words(100, 10, every=0.05), retries=0))
    rig.bring(State.ONLINE)
    own, longer = 0, 0
    for _ in range(200):
        rig.now += 0.02
        match rig.next():
            case Probe() as probe:
                rig.conclude(probe, Resynced(9))
            case Poll(span=span, block=block) as poll if span == block.span:
                own += 1
                rig.conclude(poll, [0] * span.size)
            case Poll() as poll:
                longer += 1
                rig.fail(poll)
            case Idle(until=until):
                rig.now = until
    assert rig.device.state is State.ONLINE
    assert "device offline" not in [event.event for event in rig.logged]
    assert longer == 2 * MOST_FAILED  # on each side
    assert own > 30


def test_a_refused_longer_read_leaves_those_on_the_other_side() -> None:
    driver = ModbusRtu(station=1)
    longer = LongerReads(driver, {"holding": (90, 110)}, BadAddresses(driver.cost))
    span = Span("holding", 100, 1)
    longer.refused(span, Span("holding", 100, 2), 0.0)
    _, *others = [read for read, _ in longer.choices(span)]
    assert others
    assert all(read.start + read.size == 101 for read in others)


def test_a_reload_keeps_what_the_device_is_silent_about() -> None:
    dev = single()
    for longer in (Span("D", 100, 11), Span("D", 99, 11)):
        for _ in range(MOST_FAILED):
            shapes_of(dev).longer.unanswered(dev.blocks[0].span, longer, 0.0)
    new = dev.successor(replace(dev.settings, late_guard=0.3), dev.bad_addresses.known())
    new.plan()
    new.take_over(dev)
    assert [read(shapes_of(new), new, 1.0 + 0.02 * n).size for n in range(6)] == [10] * 6


def test_the_forecast_of_two_equal_blocks_has_their_longer_reads() -> None:
    dev = device([*words(100, 10), *words(500, 10)])
    [block, _] = dev.blocks
    found = shapes_of(dev).longer.costs(block)
    assert found[0] == block.cost
    assert found[-1].reply > block.cost.reply
    alone = single()
    assert shapes_of(alone).longer.costs(alone.blocks[0]) == [alone.blocks[0].cost]


def test_acknowledgements_that_name_their_address_are_told_apart() -> None:
    spans = (Span("D", 0, 2), Span("D", 2, 2))
    for driver, apart in ((ModbusRtu(station=1), True), (Vigor(station=1), False)):
        area = "holding" if apart else "D"
        own = tuple(span._replace(area=area) for span in spans)
        found = reply_shapes(driver, (), BadAddresses(driver.cost))
        assert found is not None
        assert found.tells_apart(LongWrite(driver, own, 0), [1, 2, 3, 4]) is apart
