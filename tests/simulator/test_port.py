"""The simulated wire: characters take their time, chunks come as from a UART, talk collides."""

import asyncio
import itertools
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.errors import LineDown
from gateway.planning.wire_timing import WireTiming
from gateway.simulator.port import FIFO, open_simulator
from gateway.transport import Port, SerialSettings, SimulatorAddress, open_port
from tests.transport.ends import FixedStation, RecordingReceiver, run_from_zero
from tests.vectors import vectors

REQUEST, REPLY = (vector.frame for vector in vectors("vigor")[:2])
WIRE = WireTiming(19200, 10)
C = WIRE.character


def timed(pieces: list[tuple[float, bytes]], expected: list[tuple[float, bytes]]) -> bool:
    """True if the pieces arrived as expected, each at about its time."""
    times = [at for at, _ in pieces]
    return [data for _, data in pieces] == [data for _, data in expected] and times == (
        pytest.approx([at for at, _ in expected])
    )


def turned(data: bytes) -> bytes:
    return bytes(byte ^ 0xFF for byte in data)


def test_a_request_is_heard_when_its_last_character_is_through_by_every_station() -> None:
    async def play() -> tuple[FixedStation, FixedStation]:
        one, other = FixedStation(), FixedStation()
        port = await open_simulator([one, other], WIRE, RecordingReceiver())
        port.write(REQUEST)
        await asyncio.sleep(1)
        return one, other

    for station in run_from_zero(play):
        assert timed(station.heard, [(len(REQUEST) * C, REQUEST)])


def test_a_reply_comes_in_fifo_chunks_each_at_its_time() -> None:
    reply = bytes(range(40))

    async def play() -> RecordingReceiver:
        receiver = RecordingReceiver(asyncio.get_running_loop().time)
        port = await open_simulator([FixedStation(reply)], WIRE, receiver, turnaround=0.004)
        port.write(REQUEST)
        await asyncio.sleep(1)
        return receiver

    begin = len(REQUEST) * C + 0.004
    expected = [
        (begin + FIFO * C, reply[:FIFO]),
        (begin + 2 * FIFO * C, reply[FIFO : 2 * FIFO]),
        (begin + 40 * C, reply[2 * FIFO :]),
    ]
    assert timed(run_from_zero(play).pieces, expected)


@pytest.mark.parametrize("stalled", range(40))
def test_the_pieces_of_a_reply_keep_their_order_when_the_machine_stalls(stalled: int) -> None:
    """Found by the soak: a process that stood still while it planned the pieces swapped two."""
    reply = bytes(range(100))

    async def play() -> bytes:
        loop, receiver = asyncio.get_running_loop(), RecordingReceiver()
        port = await open_simulator([FixedStation(reply)], WIRE, receiver)
        clock, looks = loop.time, itertools.count()
        loop.time = lambda: clock() + (0.1 if next(looks) > stalled else 0.0)  # type: ignore[method-assign]
        port.write(REQUEST)
        await asyncio.sleep(1)
        return receiver.data

    assert run_from_zero(play) == reply


def test_two_frames_of_a_station_follow_each_other() -> None:
    async def play() -> bytes:
        receiver = RecordingReceiver()
        port = await open_simulator([FixedStation(REPLY, REQUEST)], WIRE, receiver)
        port.write(REQUEST)
        await asyncio.sleep(1)
        return receiver.data

    assert run_from_zero(play) == REPLY + REQUEST


def test_a_slow_station_answers_later_by_its_delay() -> None:
    async def play() -> RecordingReceiver:
        receiver = RecordingReceiver(asyncio.get_running_loop().time)
        port = await open_simulator(
            [FixedStation(b"A", delay=0.3)], WIRE, receiver, turnaround=0.005
        )
        port.write(REQUEST)
        await asyncio.sleep(1)
        return receiver

    assert timed(run_from_zero(play).pieces, [((len(REQUEST) + 1) * C + 0.305, b"A")])


def test_two_writes_at_once_follow_each_other() -> None:
    async def play() -> FixedStation:
        station = FixedStation()
        port = await open_simulator([station], WIRE, RecordingReceiver())
        port.write(REQUEST)
        port.write(REPLY)
        await asyncio.sleep(1)
        return station

    expected = [(len(REQUEST) * C, REQUEST), (len(REQUEST + REPLY) * C, REPLY)]
    assert timed(run_from_zero(play).heard, expected)


def test_two_stations_that_answer_at_once_spoil_each_other() -> None:
    async def play() -> RecordingReceiver:
        receiver = RecordingReceiver()
        port = await open_simulator([FixedStation(REPLY), FixedStation(REPLY[:2])], WIRE, receiver)
        port.write(REQUEST)
        await asyncio.sleep(1)
        return receiver

    pieces = [data for _, data in run_from_zero(play).pieces]
    assert sorted(pieces) == sorted([turned(REPLY[:2]), turned(REPLY[:2]) + REPLY[2:]])


def test_writing_while_a_station_is_sending_spoils_both() -> None:
    reply = bytes(16)

    async def play() -> tuple[RecordingReceiver, FixedStation]:
        receiver, station = RecordingReceiver(), FixedStation(reply)
        port = await open_simulator([station], WIRE, receiver, turnaround=0.005)
        port.write(b"?")
        # In the middle of the reply's tenth character; two characters touch three.
        await asyncio.sleep(C + 0.005 + 9.5 * C)
        station.frames = []
        port.write(b"ab")
        await asyncio.sleep(1)
        return receiver, station

    receiver, station = run_from_zero(play)
    assert receiver.data == bytes(9) + b"\xff" * 3 + bytes(4)
    assert [data for _, data in station.heard] == [b"?", turned(b"ab")]


def test_an_overlap_of_less_than_a_bit_is_not_noticed() -> None:
    async def play() -> tuple[RecordingReceiver, FixedStation]:
        receiver, station = RecordingReceiver(), FixedStation(REPLY)
        port = await open_simulator([station], WIRE, receiver, turnaround=0.0)
        port.write(b"?")
        await asyncio.sleep((1 + len(REPLY) - 0.05) * C)
        station.frames = []
        port.write(REQUEST)
        await asyncio.sleep(1)
        return receiver, station

    receiver, station = run_from_zero(play)
    assert receiver.data == REPLY
    assert station.heard[1][1] == REQUEST


def test_a_late_reply_meets_the_next_request() -> None:
    async def play() -> tuple[RecordingReceiver, FixedStation]:
        receiver, late = RecordingReceiver(), FixedStation(b"late", delay=0.1)
        port = await open_simulator([late], WIRE, receiver, turnaround=0.0)
        port.write(b"?")
        await asyncio.sleep(0.1 - C / 2)  # it begins one and a half characters later
        late.frames = []
        port.write(b"next")
        await asyncio.sleep(1)
        return receiver, late

    receiver, late = run_from_zero(play)
    assert receiver.data == turned(b"lat") + b"e"
    assert late.heard[1][1] == b"n" + turned(b"ext")


def test_a_request_right_after_a_reply_collides_with_nothing() -> None:
    async def play() -> list[bytes]:
        port: Port
        station = FixedStation(REPLY)

        class Hasty(RecordingReceiver):
            def received(self, data: bytes) -> None:
                super().received(data)
                if self.data.endswith(REPLY):
                    port.write(REQUEST)

        port = await open_simulator([station], WIRE, Hasty(), turnaround=0.0)
        port.write(REQUEST)
        await asyncio.sleep(10)
        return [data for _, data in station.heard]

    heard = run_from_zero(play)
    assert len(heard) > 100
    assert set(heard) == {REQUEST}


def test_not_paced_takes_no_time_and_keeps_the_order() -> None:
    async def play() -> tuple[RecordingReceiver, FixedStation]:
        receiver, station = (
            RecordingReceiver(asyncio.get_running_loop().time),
            FixedStation(bytes(300)),
        )
        port = await open_simulator([station], WIRE, receiver, paced=False)
        for number in range(20):
            port.write(bytes([number]))
        await asyncio.sleep(0.001)
        return receiver, station

    receiver, station = run_from_zero(play)
    assert [data for _, data in station.heard] == [bytes([number]) for number in range(20)]
    assert receiver.pieces == [(0.0, bytes(300))] * 20


def test_nothing_is_heard_after_close_and_writing_fails() -> None:
    async def play() -> tuple[RecordingReceiver, FixedStation]:
        receiver, station = RecordingReceiver(), FixedStation(REPLY)
        port = await open_simulator([station], WIRE, receiver)
        port.write(REQUEST)
        await asyncio.sleep(len(REQUEST) * C + 0.006)
        await port.close()
        await port.close()
        with pytest.raises(LineDown):
            port.write(REQUEST)
        await asyncio.sleep(1)
        return receiver, station

    receiver, station = run_from_zero(play)
    assert (receiver.data, receiver.losses, len(station.heard)) == (b"", [], 1)


moments = st.lists(st.tuples(st.floats(0, 0.05), st.binary(min_size=1, max_size=20)), max_size=8)


@settings(max_examples=50)
@given(moments, st.lists(st.tuples(st.binary(max_size=40), st.floats(0, 0.05)), max_size=3))
def test_the_same_play_is_heard_the_same_and_no_character_is_lost(
    writes: list[tuple[float, bytes]], answers: list[tuple[bytes, float]]
) -> None:
    async def play() -> tuple[list[tuple[float, bytes]], list[list[tuple[float, bytes]]]]:
        receiver = RecordingReceiver(asyncio.get_running_loop().time)
        stations = [
            FixedStation(*([frame] if frame else []), delay=delay) for frame, delay in answers
        ]
        port = await open_simulator(stations, WIRE, receiver)
        for pause, data in writes:
            await asyncio.sleep(pause)
            port.write(data)
        await asyncio.sleep(5)
        return receiver.pieces, [station.heard for station in stations]

    first = run_from_zero(play)
    assert run_from_zero(play) == first
    replied = sum(len(frame) for frame, _ in answers) * len(writes)
    assert sum(len(data) for _, data in first[0]) == replied


async def test_a_simulator_is_not_opened_without_its_stations() -> None:
    with pytest.raises(ValueError, match="open_simulator"):
        await open_port(SimulatorAddress(), SerialSettings(), RecordingReceiver())


class Backwards(asyncio.SelectorEventLoop):
    """Each timer fires earlier than the one before it, by far more than a piece takes."""

    def __init__(self) -> None:
        super().__init__()
        self._earlier = itertools.count()

    def call_at(  # type: ignore[override]  # its generic signature says no more
        self, when: float, callback: Callable[..., object], *args: Any, context: Any = None
    ) -> asyncio.TimerHandle:
        when -= next(self._earlier) * 1e-3
        return super().call_at(when, callback, *args, context=context)


def test_the_pieces_of_a_reply_keep_their_order_when_timers_do_not() -> None:
    received = RecordingReceiver()

    async def play() -> None:
        station = FixedStation(bytes(range(200)))
        port = await open_simulator(
            [station], WireTiming(100_000_000, 10), received, turnaround=0.15
        )
        port.write(REQUEST)
        until = asyncio.get_running_loop().time() + 5.0
        while len(received.data) < 200 and asyncio.get_running_loop().time() < until:
            await asyncio.sleep(0)

    with asyncio.Runner(loop_factory=Backwards) as runner:
        runner.run(play())
    assert received.data == bytes(range(200))
