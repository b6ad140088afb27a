"""One transaction: time-outs, late replies, echoes, noise and lost ports, byte by byte."""

import asyncio
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from gateway.errors import Evidence, Garbled, LineDown, NoReply, Refused
from gateway.line.channel import Channel, Echo
from gateway.line.transaction import Transaction
from gateway.line.wire_log import WireLog
from gateway.planning.wire_timing import WireTiming
from gateway.protocols.driver import AnyDriver, Span
from gateway.protocols.modbus import ModbusRtu
from gateway.protocols.vigor import Vigor
from gateway.stations.modbus import ModbusStation
from gateway.stations.vigor import VigorStation
from tests.sim.plant import made_device
from tests.sim.virtual import VirtualLoop, now, on_virtual_time

WIRE = WireTiming(9600, 10)
SPAN = Span("D", 0, 2)


class Far:
    """A port with a station behind it, which answers when the test says so."""

    def __init__(self, station: Any = None) -> None:
        self.station = station or VigorStation(1)
        self.sent: list[tuple[float, bytes]] = []
        self.after: Callable[[int], float | None] = lambda number: 0.1  # None: not at all
        self.spoil: Callable[[bytes], bytes] = lambda data: data
        self.talk: Transaction | None = None

    def write(self, data: bytes) -> None:
        self.sent.append((now(), data))
        reply = b"".join(self.station.hear(data, now()))
        delay = self.after(len(self.sent))
        if reply and delay is not None:
            self.say(self.spoil(reply), delay)

    def say(self, data: bytes, delay: float = 0.0) -> None:
        asyncio.get_running_loop().call_later(delay, self._deliver, data)

    def _deliver(self, data: bytes) -> None:
        assert self.talk is not None
        self.talk.received(data)

    async def close(self) -> None: ...


def opened(
    port: Far,
    driver: AnyDriver | None = None,
    *,
    quiet_since: float = 0.0,
    baudrate: int = 9600,
    echo: bool = False,
    needs_resync: bool = False,
    unmatched: list[Any] | None = None,
) -> Transaction:
    """A transaction on the port. `unmatched` collects the frames that are no reply."""
    driver = driver or Vigor(station=1)
    wire = WireTiming(baudrate, 10)
    timing = replace(driver.timing, reply_timeout=0.3, silence=0.005, silence_chars=0.0)
    device = made_device("plc", driver, wire, timing, ())
    if not needs_resync:
        device.health.answered()
    channel = Channel(port, wire, WireLog("test"), Echo("test", echo))
    channel.quiet_since = quiet_since
    frames = [] if unmatched is None else unmatched
    port.talk = Transaction(channel, device, lambda _, frame: frames.append(frame))
    return port.talk


def read(talk: Transaction, span: Span = SPAN) -> Any:
    return Vigor(station=1).read(talk, span)


@on_virtual_time
async def test_an_answer_in_pieces_is_an_answer() -> None:
    port = Far()
    port.station.memory.write("D", 0, [7, 8])
    talk = opened(port)
    port.after = lambda _: None
    asking = asyncio.create_task(read(talk))
    await asyncio.sleep(0.01)
    for i, octet in enumerate(b"".join(port.station.hear(port.sent[0][1], 0.0))):
        port.say(bytes([octet]), 0.002 * i)
    assert await asking == (7, 8)
    assert talk.traffic.exchanges == 1
    assert talk.traffic.heard == 10 + 8


@on_virtual_time
async def test_a_time_out_is_the_characters_own_time_and_the_stations() -> None:
    port = Far()
    port.after = lambda _: None
    start = now()
    with pytest.raises(NoReply):
        await read(opened(port))
    request, reply = Vigor(station=1).cost(SPAN)  # type: ignore[misc]
    assert now() - start == pytest.approx((request + reply) * WIRE.character + 0.3)


@on_virtual_time
async def test_the_silence_before_a_request_is_kept_by_the_clock() -> None:
    port = Far()
    await read(opened(port, quiet_since=now() + 0.02))
    assert port.sent[0][0] == pytest.approx(now() - 0.1)
    assert port.sent[0][0] >= 1000.0 + 0.025


@pytest.mark.parametrize("baudrate", [9600, 115200])  # above 19200 it looks at the clock
@on_virtual_time
async def test_watching_the_clock_ends_the_silence_neither_early_nor_much_late(
    baudrate: int,
) -> None:
    port, start = Far(), now()
    await read(opened(port, quiet_since=start, baudrate=baudrate))
    assert 0.005 - 1e-9 <= port.sent[0][0] - start <= 0.0051


@on_virtual_time
async def test_bytes_heard_before_the_request_answer_nothing() -> None:
    """Half a late reply before the question and half of it after: still a late reply."""
    before = Far()
    before.station.memory.write("D", 0, [666, 666])
    await read(opened(before))
    late = b"".join(before.station.hear(before.sent[0][1], 0.0))
    port = Far()
    port.station.memory.write("D", 0, [1, 1])
    port.after = lambda _: None
    talk = opened(port, quiet_since=now())
    asking = asyncio.create_task(read(talk))
    await asyncio.sleep(0)
    assert not port.sent
    talk.received(late[:9])  # in the silence before the request
    await asyncio.sleep(0.02)
    assert port.sent
    talk.received(late[9:])
    talk.received(b"".join(port.station.hear(port.sent[0][1], 0.0)))
    assert await asking == (1, 1)


@on_virtual_time
async def test_settling_ends_when_the_late_answer_has_passed() -> None:
    port = Far()
    port.after = lambda _: 0.5
    talk = opened(port)
    with pytest.raises(NoReply):
        await read(talk)
    start = now()
    late = await talk.settle(10.0, 0.02)
    assert late is not None
    assert now() - start == pytest.approx(late)
    assert now() == pytest.approx(port.sent[0][0] + 0.5)


@on_virtual_time
async def test_settling_ends_with_the_guard_when_nothing_comes() -> None:
    port = Far()
    port.after = lambda _: None
    talk = opened(port)
    with pytest.raises(NoReply):
        await read(talk)
    start = now()
    assert await talk.settle(0.4, 0.02) is None
    assert now() - start == pytest.approx(0.4)


@pytest.mark.parametrize("needs_resync", [False, True])
@on_virtual_time
async def test_a_late_refusal_is_a_late_answer_unless_it_may_answer_something_older(
    needs_resync: bool,
) -> None:
    port = Far(VigorStation(1, holes=[("D", 0)]))
    port.after = lambda _: 0.5
    talk = opened(port, needs_resync=needs_resync)
    with pytest.raises(NoReply):
        await read(talk)
    late = await talk.settle(10.0, 0.02)
    assert (late is None) is needs_resync


@on_virtual_time
async def test_another_frame_does_not_end_the_guard() -> None:
    port = Far()
    port.after = lambda _: None
    frames: list[Any] = []
    talk = opened(port, unmatched=frames)
    with pytest.raises(NoReply):
        await read(talk)
    other = Far()
    await read(opened(other), Span("D", 0, 5))
    frame = b"".join(other.station.hear(other.sent[0][1], 0.0))
    port.say(frame, 0.1)
    port.talk = talk
    start = now()
    assert await talk.settle(0.4, 0.02) is None
    assert now() - start == pytest.approx(0.4)
    assert len(frames) == 1


@on_virtual_time
async def test_settling_can_be_cancelled() -> None:
    port = Far()
    port.after = lambda _: None
    talk = opened(port)
    with pytest.raises(NoReply):
        await read(talk)
    settling = asyncio.create_task(talk.settle(10.0, 0.02))
    await asyncio.sleep(0.1)
    settling.cancel()
    with pytest.raises(asyncio.CancelledError):
        await settling


@on_virtual_time
async def test_after_nonsense_it_waits_for_quiet() -> None:
    port = Far()
    port.spoil = lambda data: data[:-1] + b"?"
    talk = opened(port)
    with pytest.raises(Garbled) as caught:
        await read(talk)
    assert caught.value.evidence is Evidence.CHECKSUM
    for i in range(5):
        port.say(b"noise", 0.01 * i)
    start = now()
    await talk.settle(0.5, 0.02)
    assert now() - start == pytest.approx(0.06)


@pytest.mark.parametrize(
    ("heard", "evidence"),
    [
        ("station", Evidence.STATION),
        ("shape", Evidence.SHAPE),
        ("noise", Evidence.NOISE),
        ("echo", Evidence.ECHO),
    ],
)
@on_virtual_time
async def test_what_was_heard_instead_says_what_is_wrong(heard: str, evidence: Evidence) -> None:
    port = Far()
    port.after = lambda _: None
    talk = opened(port)
    asking = asyncio.create_task(read(talk))
    await asyncio.sleep(0.01)
    other = Far(VigorStation(2 if heard == "station" else 1))
    driver = Vigor(station=other.station.station)
    span = Span("D", 0, 3) if heard == "shape" else SPAN
    await driver.read(opened(other, driver), span)
    frame = b"".join(other.station.hear(other.sent[0][1], 0.0))
    talk.received(
        {"station": frame, "shape": frame, "noise": b"\xffU\x00", "echo": port.sent[0][1]}[heard]
    )
    with pytest.raises(Garbled) as caught:
        await asking
    assert caught.value.evidence is evidence


@on_virtual_time
async def test_a_lost_port_ends_the_question_and_all_that_would_follow() -> None:
    port = Far()
    port.after = lambda _: None
    talk = opened(port)
    asking = asyncio.create_task(read(talk))
    await asyncio.sleep(0.1)
    talk.lost(LineDown("gone"))
    with pytest.raises(LineDown):
        await asking
    with pytest.raises(LineDown):
        await read(talk)
    assert len(port.sent) == 1


@pytest.mark.parametrize("garbled", [False, True])
@on_virtual_time
async def test_a_lost_port_ends_the_settling(garbled: bool) -> None:
    port = Far()
    port.after = lambda _: 0.1 if garbled else None
    port.spoil = lambda data: data[:-1] + b"?"
    talk = opened(port)
    with pytest.raises(Garbled if garbled else NoReply):
        await read(talk)
    settling = asyncio.create_task(talk.settle(10.0, 0.02))
    await asyncio.sleep(0.001)
    talk.lost(LineDown("gone"))
    start = now()
    await settling
    assert now() - start <= 0.02


@on_virtual_time
async def test_noise_between_two_questions_of_a_turn_does_no_harm() -> None:
    port = Far()
    talk = opened(port)
    await read(talk)
    broken = b"".join(port.station.hear(port.sent[0][1], 0.0))[:-1] + b"?"
    talk.received(broken)
    assert await read(talk) == (0, 0)


@on_virtual_time
async def test_a_refusal_is_raised_at_once() -> None:
    port = Far(VigorStation(1, holes=[("D", 0)]))
    start = now()
    with pytest.raises(Refused):
        await read(opened(port))
    assert now() - start == pytest.approx(0.1)


class Echoing(Far):
    """A two-wire adapter: what is sent comes back, with what its switching adds before it."""

    added = b""
    adapter = True

    def write(self, data: bytes) -> None:
        if self.adapter:
            self.say(self.added + data, 0.01)
        super().write(data)


@pytest.mark.parametrize("added", [b"", b"\x00", b"\xff\x06"])
@on_virtual_time
async def test_an_echo_is_dropped_whatever_comes_before_it(added: bytes) -> None:
    port = Echoing()
    port.added = added
    port.station.memory.write("D", 0, [3, 4])
    assert await read(opened(port, echo=True)) == (3, 4)


@pytest.mark.parametrize("added", [b"", b"\x00"])
@on_virtual_time
async def test_an_echo_is_never_taken_for_an_acknowledgement(added: bytes) -> None:
    """Modbus acknowledges the writing of one register with the very bytes of the request."""
    driver = ModbusRtu(station=1)
    port = Echoing(ModbusStation(station=1, framing="rtu"))
    port.added = added
    port.after = lambda _: None  # the station is dead
    talk = opened(port, driver, echo=True)
    with pytest.raises((NoReply, Garbled)):
        await driver.write(talk, Span("holding", 5, 1), [42])


@on_virtual_time
async def test_where_the_echo_is_missing_nothing_is_believed() -> None:
    driver = ModbusRtu(station=1)
    port = Echoing(ModbusStation(station=1, framing="rtu"))
    port.adapter = False
    port.spoil = lambda data: b"\x01" + data
    with pytest.raises(Garbled, match="did not come back"):
        await driver.read(opened(port, driver, echo=True), Span("holding", 5, 2))


@on_virtual_time
async def test_the_turnaround_is_the_stations_own_time() -> None:
    port = Far()
    request, reply = Vigor(station=1).cost(SPAN)  # type: ignore[misc]
    port.after = lambda _: (request + reply) * WIRE.character + 0.04
    talk = opened(port)
    await read(talk)
    assert talk.traffic.turnaround == pytest.approx(0.04)


@on_virtual_time
async def test_a_reply_that_waited_while_the_loop_stood_still_is_late() -> None:
    """Its bytes may have arrived at any moment since, so no sample may carry this time."""
    port = Far()
    port.station.memory.write("D", 0, [7, 8])
    talk = opened(port)
    port.after = lambda _: None
    asking = asyncio.create_task(read(talk))
    await asyncio.sleep(0.01)
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualLoop)
    loop.pass_time(3.0)
    talk.received(b"".join(port.station.hear(port.sent[0][1], now())))
    with pytest.raises(NoReply):
        await asking
    assert await talk.settle(0.5, 0.02) == 0.0
