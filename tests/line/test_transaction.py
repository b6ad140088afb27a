"""One transaction: time-outs, late replies, echoes, noise and lost ports."""

import asyncio
from contextlib import suppress
from typing import Any

import pytest

from gateway.engine.jobs.jobs import Settled
from gateway.errors import Evidence, Garbled, LineDown, NoReply, Refused
from gateway.protocols.driver import Span
from gateway.protocols.frames import FrameDriver
from gateway.protocols.modbus import ModbusRtu, ModbusTcp
from gateway.protocols.vigor import Vigor
from gateway.stations.modbus import ModbusStation
from gateway.stations.vigor import VigorStation
from tests.line.fake_port import SPAN, WIRE, EchoingPort, FakePort, opened, read
from tests.protocols.frames_examples import load
from tests.sim.virtual import VirtualLoop, now, on_virtual_time


@on_virtual_time
async def test_a_reply_in_pieces_is_a_reply() -> None:
    port = FakePort()
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
async def test_a_time_out_adds_the_time_of_the_characters_to_reply_timeout() -> None:
    port = FakePort()
    port.after = lambda _: None
    start = now()
    with pytest.raises(NoReply):
        await read(opened(port))
    request, reply = Vigor(station=1).cost(SPAN)  # type: ignore[misc]
    assert now() - start == pytest.approx((request + reply) * WIRE.character + 0.3)


@on_virtual_time
async def test_the_silence_before_a_request_is_kept_by_the_clock() -> None:
    port = FakePort()
    await read(opened(port, quiet_since=now() + 0.02))
    assert port.sent[0][0] == pytest.approx(now() - 0.1)
    assert port.sent[0][0] >= 1000.0 + 0.025


@pytest.mark.parametrize("baudrate", [9600, 115200])  # above 19200 the channel looks at the clock
@on_virtual_time
async def test_the_silence_ends_neither_early_nor_much_late(
    baudrate: int,
) -> None:
    port, start = FakePort(), now()
    await read(opened(port, quiet_since=start, baudrate=baudrate))
    assert 0.005 - 1e-9 <= port.sent[0][0] - start <= 0.0051


@on_virtual_time
async def test_bytes_from_before_the_request_are_no_reply() -> None:
    """A late reply of which one half arrives before the request is still late."""
    before = FakePort()
    before.station.memory.write("D", 0, [666, 666])
    await read(opened(before))
    late = b"".join(before.station.hear(before.sent[0][1], 0.0))
    port = FakePort()
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
async def test_settling_ends_with_the_late_reply() -> None:
    port = FakePort()
    port.after = lambda _: 0.5
    talk = opened(port)
    with pytest.raises(NoReply):
        await read(talk)
    start = now()
    late = (await talk.settle(10.0, 0.02)).late
    assert late is not None
    assert now() - start == pytest.approx(late)
    assert now() == pytest.approx(port.sent[0][0] + 0.5)


@on_virtual_time
async def test_settling_without_a_late_reply_ends_with_the_guard() -> None:
    port = FakePort()
    port.after = lambda _: None
    talk = opened(port)
    with pytest.raises(NoReply):
        await read(talk)
    start = now()
    assert (await talk.settle(0.4, 0.02)).late is None
    assert now() - start == pytest.approx(0.4)


@pytest.mark.parametrize("needs_resync", [False, True])
@on_virtual_time
async def test_a_late_refusal_is_the_late_reply_unless_a_resync_is_needed(
    needs_resync: bool,
) -> None:
    port = FakePort(VigorStation(1, holes=[("D", 0)]))
    port.after = lambda _: 0.5
    talk = opened(port, needs_resync=needs_resync)
    with pytest.raises(NoReply):
        await read(talk)
    late = (await talk.settle(10.0, 0.02)).late
    assert (late is None) is needs_resync


@on_virtual_time
async def test_an_unmatched_frame_does_not_end_the_settling() -> None:
    port = FakePort()
    port.after = lambda _: None
    frames: list[Any] = []
    talk = opened(port, unmatched=frames)
    with pytest.raises(NoReply):
        await read(talk)
    other = FakePort()
    await read(opened(other), Span("D", 0, 5))
    frame = b"".join(other.station.hear(other.sent[0][1], 0.0))
    port.say(frame, 0.1)
    port.talk = talk
    start = now()
    assert (await talk.settle(0.4, 0.02)).late is None
    assert now() - start == pytest.approx(0.4)
    assert len(frames) == 1


@on_virtual_time
async def test_settling_can_be_cancelled() -> None:
    port = FakePort()
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
async def test_settling_after_a_garbled_reply_waits_for_quiet() -> None:
    port = FakePort()
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
async def test_the_evidence_of_a_time_out_is_what_was_heard(heard: str, evidence: Evidence) -> None:
    port = FakePort()
    port.after = lambda _: None
    talk = opened(port)
    asking = asyncio.create_task(read(talk))
    await asyncio.sleep(0.01)
    other = FakePort(VigorStation(2 if heard == "station" else 1))
    driver = Vigor(station=other.station.station)
    span = Span("D", 0, 3) if heard == "shape" else SPAN
    await driver.read(opened(other, driver), span)
    frame = b"".join(other.station.hear(other.sent[0][1], 0.0))
    found = {"station": frame, "shape": frame, "noise": b"\xffU\x00", "echo": port.sent[0][1]}
    talk.received(found[heard])
    with pytest.raises(Garbled) as caught:
        await asking
    assert caught.value.evidence is evidence
    assert caught.value.data == found[heard]
    assert found[heard].hex(" ") not in str(caught.value)


@pytest.mark.parametrize(
    ("number", "evidence"), [(b"\x0d\xb6", Evidence.SHAPE), (b"\x00\x01", Evidence.STATION)]
)
@on_virtual_time
async def test_a_repeated_numbered_reply_of_another_unit_is_no_evidence_against_this_one(
    number: bytes, evidence: Evidence
) -> None:
    """Behind one connection a unit replied twice. The other one "had a wrong number"."""
    port = FakePort()
    port.after = lambda _: None
    driver = ModbusTcp(station=1)
    talk = opened(port, driver)
    asking = asyncio.create_task(driver.read(talk, Span("holding", 0, 1)))
    await asyncio.sleep(0.01)
    assert port.sent[0][1][:2] == b"\x00\x01"
    talk.received(number + b"\x00\x00\x00\x05\x02\x03\x02\x53\x8a")
    with pytest.raises(Garbled) as caught:
        await asking
    assert caught.value.evidence is evidence


@on_virtual_time
async def test_only_late_answers_of_a_bridge_are_no_noise() -> None:
    """Probes at the pace of noise kept a bridge busy for ever: it waits longer for each of them."""
    port = FakePort()
    port.after = lambda _: None
    driver = ModbusTcp(station=1)
    talk = opened(port, driver)
    with pytest.raises(NoReply):
        await driver.read(talk, Span("holding", 0, 1))
    asking = asyncio.create_task(driver.read(talk, Span("holding", 4, 2)))
    await asyncio.sleep(0.01)
    talk.received(b"\x00\x01\x00\x00\x00\x03\x01\x83\x0b")
    with pytest.raises(Garbled) as caught:
        await asking
    assert caught.value.evidence is Evidence.SLOW


@on_virtual_time
async def test_port_loss_ends_the_open_request_and_all_after_it() -> None:
    port = FakePort()
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
async def test_port_loss_ends_the_settling(garbled: bool) -> None:
    port = FakePort()
    port.after = lambda _: 0.1 if garbled else None
    port.spoil = lambda data: data[:-1] + b"?"
    talk = opened(port)
    with pytest.raises(Garbled if garbled else NoReply):
        await read(talk)
    settling = asyncio.create_task(talk.settle(10.0, 0.02))
    await asyncio.sleep(0.001)
    talk.lost(LineDown("gone"))
    start = now()
    with suppress(LineDown):  # a silence that was not waited for shows nothing
        await settling
    assert now() - start <= 0.02


@on_virtual_time
async def test_a_wire_that_is_never_quiet_does_not_settle() -> None:
    port = FakePort()
    talk = opened(port)
    await read(talk)
    settling = asyncio.create_task(talk.settle(1.0, 0.3))
    for _ in range(6):
        await asyncio.sleep(0.2)
        talk.received(b"?")
    assert await settling == Settled(late=None, quiet=False)
    assert await talk.settle(1.0, 0.3) == Settled(late=None)


@on_virtual_time
async def test_noise_between_two_requests_of_a_transaction_is_dropped() -> None:
    port = FakePort()
    talk = opened(port)
    await read(talk)
    broken = b"".join(port.station.hear(port.sent[0][1], 0.0))[:-1] + b"?"
    talk.received(broken)
    assert await read(talk) == (0, 0)


@on_virtual_time
async def test_a_refusal_is_raised_at_once() -> None:
    port = FakePort(VigorStation(1, holes=[("D", 0)]))
    start = now()
    with pytest.raises(Refused):
        await read(opened(port))
    assert now() - start == pytest.approx(0.1)


@pytest.mark.parametrize("added", [b"", b"\x00", b"\xff\x06"])
@on_virtual_time
async def test_an_echo_is_dropped_with_the_bytes_before_it(added: bytes) -> None:
    port = EchoingPort()
    port.added = added
    port.station.memory.write("D", 0, [3, 4])
    assert await read(opened(port, echo=True)) == (3, 4)


@pytest.mark.parametrize("added", [b"", b"\x00"])
@on_virtual_time
async def test_an_echo_is_no_acknowledgement(added: bytes) -> None:
    """Modbus acknowledges the write of one register with the bytes of the request."""
    driver = ModbusRtu(station=1)
    port = EchoingPort(ModbusStation(station=1, framing="rtu"))
    port.added = added
    port.after = lambda _: None  # the station is mute
    talk = opened(port, driver, echo=True)
    with pytest.raises((NoReply, Garbled)):
        await driver.write(talk, Span("holding", 5, 1), [42])


@pytest.mark.parametrize(("before", "extra"), [(b"", 0), (b"\x00", 0), (b"\x06151", 1)])
@on_virtual_time
async def test_more_than_noise_before_an_echo_is_an_extra_reply(before: bytes, extra: int) -> None:
    """The own reply to the request before, while the next one is sent: no frame is left of it."""
    port = EchoingPort()
    port.added = before
    talk = opened(port, echo=True)
    await read(talk)
    assert talk.traffic.extra == extra


@on_virtual_time
async def test_without_the_expected_echo_no_reply_counts() -> None:
    driver = ModbusRtu(station=1)
    port = EchoingPort(ModbusStation(station=1, framing="rtu"))
    port.adapter = False
    port.spoil = lambda data: b"\x01" + data
    with pytest.raises(Garbled, match="did not come back"):
        await driver.read(opened(port, driver, echo=True), Span("holding", 5, 2))


@on_virtual_time
async def test_the_turnaround_is_the_stations_own_time() -> None:
    port = FakePort()
    request, reply = Vigor(station=1).cost(SPAN)  # type: ignore[misc]
    port.after = lambda _: (request + reply) * WIRE.character + 0.04
    talk = opened(port)
    await read(talk)
    assert talk.traffic.turnaround == pytest.approx(0.04)


@on_virtual_time
async def test_a_reply_that_waited_while_the_loop_stood_still_is_late() -> None:
    """Its bytes may have arrived at any moment since, so no sample may carry this time."""
    port = FakePort()
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
    assert (await talk.settle(0.5, 0.02)).late == 0.0


@pytest.mark.parametrize("stood_still", [0.0, 3.0])
@on_virtual_time
async def test_a_silence_that_ends_a_reply_long_after_its_time_out_makes_it_late(
    stood_still: float,
) -> None:
    """It was a value of now, three seconds old."""
    ask = {"send": "W?", "match": "(?P<w>[0-9]{5})", "fields": {"w": {"type": "integer"}}}
    scale = FrameDriver(load({"framing": {"gap": "50ms"}, "ask": {"w": ask}}))
    port = FakePort()
    port.after = lambda _: None
    talk = opened(port, scale)
    asking = asyncio.create_task(scale.read(talk, Span("ask w", 0, 1)))
    await asyncio.sleep(0.01)
    talk.received(b"00145")
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualLoop)
    loop.pass_time(stood_still)
    if stood_still:
        with pytest.raises(Garbled):
            await asking
    else:
        assert await asking == [145]
