"""Each job: the driver's requests in their order, and the result."""

import asyncio
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, cast

import pytest

from gateway.engine.device.device import Device
from gateway.engine.jobs.jobs import (
    Answer,
    Confirm,
    HeldTogether,
    Poll,
    Probe,
    ReadBack,
    Repeat,
    Result,
    Resynced,
    Sent,
    Settle,
    Settled,
    Transacted,
    WriteTogether,
)
from gateway.engine.jobs.requests import Command, Resyncs, Write
from gateway.errors import BadValue, LineDown, NoReply, Refused, Unclear, Unsteady
from gateway.line.perform import perform
from gateway.planning.planner import Block
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.driver import Cost, Span
from gateway.protocols.vigor import Vigor
from gateway.stations.computer_link import ComputerLinkStation
from gateway.stations.vigor import VigorStation
from gateway.tags import Tag, WriteRule
from tests.doubles import Script, Wire, result_of
from tests.line.fake_port import FakePort, opened
from tests.sim.bench import WIRE
from tests.sim.links import link_station
from tests.sim.plant import device, made_device, make_tag
from tests.sim.virtual import on_virtual_time
from tests.vectors import vectors

LINK = ComputerLink(station=1, monitor=True)
LOST = NoReply("no reply")


class Plc:
    """A Computer Link PLC on a `Wire`; it does not reply to the commands in `ignored`."""

    def __init__(self, *, holes: Iterable[tuple[str, int]] = (), verify_reads: int = 1) -> None:
        self.station: ComputerLinkStation = link_station(LINK)
        self.station.memory.holes = set(holes)
        self.ignored: set[str] = set()
        self.device = made_device(
            "plc", LINK, WIRE, LINK.timing, (make_tag("D0", LINK),), verify_reads=verify_reads
        )
        self.wire = Wire(LINK, self.respond)

    def respond(self, data: bytes) -> list[bytes]:
        replies = self.station.hear(data, 0.0)
        return [] if data[5:7].decode() in self.ignored else replies

    def perform(self, job: Transacted) -> Result:
        # A double of `Talk`: only `settle` needs more of a transaction.
        return result_of(perform(job, cast(Any, self.wire)))

    @property
    def commands(self) -> list[str]:
        """The two letters of every request."""
        return [data[5:7].decode() for data in self.wire.sent]

    def words(self, first: int, count: int = 1) -> list[int]:
        return list(self.station.memory.read("D", first, count))

    def poll(self, *texts: str, listed: bool = False, register: bool = False) -> Poll:
        tags = tuple(tag(text) for text in texts)
        span = tags[0].span._replace(size=len(tags) if not listed else 1)
        spans = tuple(tag.span for tag in tags) if listed else ()
        block = Block(span, 1.0, tags, Cost(0, 0), listed=spans)
        return Poll(self.device, block, block.span, register=register)

    def write(
        self, text: str, units: Sequence[int], rule: WriteRule | None = None, **settings: Any
    ) -> Write:
        return Write(self.device, tag(text, write=rule or WriteRule(), **settings), units, 0.0)


def tag(text: str, **settings: Any) -> Tag:
    return make_tag(text, LINK, **settings)


def test_a_poll_reads_its_block_once() -> None:
    plc = Plc()
    plc.station.memory.write("D", 0, [7, 8])
    assert plc.perform(plc.poll("D0", "D1")) == [7, 8]
    assert plc.commands == ["WR"]


def test_a_poll_follows_the_example_of_the_manual() -> None:
    dev = device([make_tag("D1"), make_tag("D2")], station=0)
    request, reply = (vector.frame.hex(" ") for vector in vectors("vigor")[2:4])
    script = Script(dev.driver, f"> {request}", f"< {reply}")
    result = result_of(perform(Poll(dev, dev.blocks[0], dev.blocks[0].span), cast(Any, script)))
    assert result == (0x1234, 0xABCD)
    script.done()


def test_the_monitor_list_is_registered_before_it_is_read() -> None:
    plc = Plc()
    plc.station.memory.write("D", 0, [7])
    plc.station.memory.write("D", 500, [8])
    assert plc.perform(plc.poll("D0", "D500", listed=True, register=True)) == [7, 8]
    assert plc.perform(plc.poll("D0", "D500", listed=True)) == [7, 8]
    assert plc.commands == ["WM", "MN", "MN"]


def test_verify_reads_compares_two_reads() -> None:
    plc = Plc(verify_reads=2)
    plc.station.memory.write("D", 0, [7])
    assert plc.perform(plc.poll("D0")) == [7]
    assert plc.commands == ["WR", "WR"]


def test_verify_reads_refuses_two_reads_that_differ() -> None:
    plc, count = Plc(verify_reads=2), iter(range(100))
    plc.station.memory.animate("D", 0, lambda now: next(count))
    assert isinstance(plc.perform(plc.poll("D0")), Unsteady)
    assert plc.commands == ["WR", "WR"]


@pytest.mark.parametrize("before", [0, 2])
def test_verify_reads_looks_at_tags_alone(before: int) -> None:
    """Registers between them and around them change: the tags of the block were never good."""
    plc, count = Plc(verify_reads=2), iter(range(100))
    plc.station.memory.write("D", 10, [7, 0, 9])
    plc.station.memory.animate("D", 11, lambda now: next(count))
    plc.station.memory.animate("D", 9, lambda now: next(count))
    tags = (tag("D10"), tag("D12"))
    block = Block(Span("D", 10, 3), 1.0, tags, Cost(0, 0))
    poll = Poll(plc.device, block, Span("D", 10 - before, 3 + before))
    units = plc.perform(poll)
    assert isinstance(units, list)
    assert [units[before], units[before + 2]] == [7, 9]
    plc.station.memory.animate("D", 12, lambda now: next(count))
    assert isinstance(plc.perform(poll), Unsteady)


def test_verify_reads_registers_a_monitor_list_once() -> None:
    plc = Plc(verify_reads=3)
    assert plc.perform(plc.poll("D0", "D500", listed=True, register=True)) == [0, 0]
    assert plc.commands == ["WM", "MN", "MN", "MN"]


def test_a_write_is_one_request() -> None:
    plc = Plc()
    assert plc.perform(plc.write("D5", [42])) == Sent(acknowledged=True, held=None)
    assert plc.commands == ["WW"]
    assert plc.words(5) == [42]


def test_a_refused_resync_after_a_write_is_followed_by_the_last_good_read() -> None:
    vigor, station = Vigor(station=1), VigorStation(1)
    read, last = [0], Span("D", 9, 3)
    of_last = Wire(vigor, lambda data: station.hear(data, 0.0))
    result_of(vigor.read(cast(Any, of_last), last))

    def respond(data: bytes) -> list[bytes]:
        if data[3:5] == b"51":
            read[0] += 1
            station.memory.guard = (lambda *_: True) if data != of_last.sent[0] else None
        else:
            station.memory.guard = None
        return station.hear(data, 0.0)

    dev = made_device("plc", vigor, WIRE, vigor.timing, (make_tag("D9", vigor),))
    dev.good_reads.note(last)
    write = Write(dev, make_tag("D9", vigor, write=WriteRule()), [42], 0.0)
    write.resyncs = Resyncs(after=2)
    wire = Wire(vigor, respond)
    assert result_of(perform(write, cast(Any, wire))) == Sent(acknowledged=True)
    assert wire.sent[-1] == of_last.sent[0]
    assert read[0] > 1  # the resync was refused before


def test_a_verified_write_is_read_back() -> None:
    plc = Plc()
    assert plc.perform(plc.write("D5", [42], WriteRule(verify=True))) == Sent(held=[42])
    assert plc.commands == ["WW", "WR"]


def test_a_refused_read_back_is_part_of_the_result() -> None:
    plc = Plc()
    hear = plc.station.hear

    def hearing(data: bytes, now: float) -> list[bytes]:
        plc.station.memory.holes = {("D", 5)} if data[5:7] == b"WR" else set()
        return hear(data, now)

    plc.station.hear = hearing  # type: ignore[method-assign]  # refuses the read only
    result = plc.perform(plc.write("D5", [42], WriteRule(verify=True)))
    assert isinstance(result, Sent)
    assert isinstance(result.refused_back, Refused)
    assert result.held is None
    assert plc.words(5) == [42]


@pytest.mark.parametrize(("value", "expected"), [(1, 0b1010_1100), (0, 0b1010_0100)])
def test_a_bit_write_reads_the_word_and_changes_one_bit(value: int, expected: int) -> None:
    plc = Plc()
    plc.station.memory.write("D", 5, [0b1010_1100 if value == 0 else 0b1010_0100])
    assert plc.perform(plc.write("D5.3", [value])) == Sent()
    assert plc.commands == ["WR", "WW"]
    assert plc.words(5) == [expected]


def test_a_bit_write_without_the_word_sends_no_write() -> None:
    plc = Plc(holes=[("D", 5)])
    assert isinstance(plc.perform(plc.write("D5.3", [1])), Refused)
    assert plc.commands == ["WR"]


def test_several_writes_share_one_request() -> None:
    plc = Plc()
    writes = [plc.write("D5", [42]), plc.write("D500", [43])]
    assert plc.perform(WriteTogether(plc.device, writes)) == Sent()
    assert plc.commands == ["WT"]
    assert (plc.words(5), plc.words(500)) == ([42], [43])


def test_writes_refused_together_are_read_back_one_by_one() -> None:
    plc = Plc(holes=[("D", 500)])
    plc.station.memory.write("D", 5, [42])
    writes = [plc.write("D5", [42]), plc.write("D500", [43])]
    result = plc.perform(ReadBack(plc.device, writes, Refused("no", code="06")))
    assert isinstance(result, HeldTogether)
    first, second = result.units
    assert first == [42]
    assert isinstance(second, Refused)
    assert plc.commands == ["WR", "WR"]


def test_a_repetition_sends_the_same_write() -> None:
    plc = Plc()
    write = plc.write("D5", [42], WriteRule(repeat=True))
    assert plc.perform(Repeat(plc.device, write, LOST)) == Sent()
    assert plc.commands == ["WW"]
    assert plc.words(5) == [42]


@pytest.mark.parametrize("verify", [False, True])
def test_a_confirmation_resyncs_before_it_reads_back(verify: bool) -> None:
    plc = Plc()
    plc.station.memory.write("D", 5, [42])
    write = plc.write("D5", [42], WriteRule(repeat=True, verify=verify))
    result = plc.perform(Confirm(plc.device, (write,), write.tag.span, LOST, write.tag.span, 7))
    assert result == (Sent(held=[42]) if verify else Sent())
    assert plc.commands == (["TT", "WR"] if verify else ["TT"])


def test_a_confirmation_whose_resync_is_refused_stays_unclear() -> None:
    plc = Plc()
    hear = plc.station.hear
    plc.station.hear = (  # type: ignore[method-assign]  # refuses the loopback only
        lambda data, now: [b"\x1501FF06"] if data[5:7] == b"TT" else hear(data, now)
    )
    write = plc.write("D5", [42], WriteRule(verify=True))
    result = plc.perform(Confirm(plc.device, (write,), write.tag.span, LOST, write.tag.span, 7))
    assert isinstance(result, Unclear)
    assert "WR" not in plc.commands


def test_a_probe_is_a_resync() -> None:
    plc = Plc()
    result = plc.perform(Probe(plc.device, None, 7))
    assert isinstance(result, Resynced)
    assert result.told_from > 1
    assert plc.commands == ["TT"]


def test_a_command_returns_the_reply_of_the_device() -> None:
    plc = Plc()
    assert plc.perform(Command(plc.device, "loopback", "ABC", 0.0)) == "ABC"
    assert plc.commands == ["TT"]


def test_a_wrong_argument_of_a_command_is_a_result_and_sends_nothing() -> None:
    plc = Plc()
    assert isinstance(plc.perform(Command(plc.device, "run", "now", 0.0)), BadValue)
    assert plc.commands == []


def test_an_answer_is_sent_without_waiting_for_a_reply() -> None:
    class Recorder:
        """Keeps the frames of `tell`."""

        frames: list[bytes] = []  # noqa: RUF012  (one instance)

        async def tell(self, frame: bytes) -> None:
            self.frames.append(frame)

    recorder = Recorder()
    job = Answer(Plc().device, b"ACK", 1.0)
    assert result_of(perform(job, cast(Any, recorder))) is None
    assert recorder.frames == [b"ACK"]


@pytest.mark.parametrize("delay", [0.4, None])
@on_virtual_time
async def test_settling_returns_the_delay_of_the_late_reply(delay: float | None) -> None:
    port = FakePort()
    port.after = lambda _: delay
    transaction = opened(port)
    dev = device([make_tag("D0"), make_tag("D1")])
    poll = Poll(dev, dev.blocks[0], dev.blocks[0].span)
    assert isinstance(await perform(poll, transaction), NoReply)
    result = await perform(Settle(dev, 0.5, 0.02, poll), transaction)
    assert isinstance(result, Settled)
    assert (result.late is None) == (delay is None)


def jobs(plc: Plc) -> list[Transacted]:
    write = plc.write("D5", [42], WriteRule(verify=True))
    return [
        plc.poll("D0"),
        plc.poll("D0", "D500", listed=True, register=True),
        write,
        WriteTogether(plc.device, [write, plc.write("D500", [43])]),
        Repeat(plc.device, write, LOST),
        Confirm(plc.device, (write,), write.tag.span, LOST, write.tag.span, 7),
        Probe(plc.device, None, 7),
        Command(plc.device, "loopback", "ABC", 0.0),
    ]


@pytest.mark.parametrize("number", range(8))
def test_a_missing_reply_is_the_result_of_every_job(number: int) -> None:
    plc = Plc()
    plc.ignored = {"WR", "WW", "WT", "WM", "MN", "TT"}
    assert isinstance(plc.perform(jobs(plc)[number]), NoReply)
    assert len(plc.commands) == 1


@pytest.mark.parametrize("number", range(8))
@on_virtual_time
async def test_a_lost_port_is_the_result_of_every_job(number: int) -> None:
    plc = Plc()
    port = FakePort(plc.station)
    port.after = lambda _: None
    transaction = opened(port, LINK)
    performing = asyncio.create_task(perform(jobs(plc)[number], transaction))
    await asyncio.sleep(0.1)
    transaction.lost(LineDown("unplugged"))
    assert isinstance(await performing, LineDown)
    assert len(port.sent) == 1


def plain_device() -> Device:
    """A device whose driver has neither commands nor scattered writes."""
    driver = Vigor(station=1)
    timing = replace(driver.timing, reply_timeout=0.3)
    return made_device("plc", driver, WIRE, timing, (make_tag("D0", driver, write=WriteRule()),))


def test_a_job_that_the_driver_cannot_perform_is_a_bug() -> None:
    dev = plain_device()
    wire: Any = Wire(dev.driver, lambda data: [])
    write = Write(dev, dev.tags[0], [1], 0.0)
    for job in (Command(dev, "run", "", 0.0), WriteTogether(dev, [write, write])):
        with pytest.raises(TypeError, match="plc cannot perform"):
            result_of(perform(job, wire))
    assert wire.sent == []
