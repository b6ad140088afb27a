"""The simulated wire: characters take their time, chunks come as from a UART, talk collides."""

import asyncio
import itertools
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.errors import LineDown
from gateway.planning.wire_timing import WireTiming
from gateway.simulator.port import FIFO, open_simulator
from gateway.transport import Port, SerialSettings, SimulatorAddress, open_port
from tests.transport.ends import Heard, Says, counted
from tests.vectors import vectors

REQUEST, REPLY = (vector.frame for vector in vectors("vigor")[:2])
WIRE = WireTiming(19200, 10)
C = WIRE.character


def turned(data: bytes) -> bytes:
    return bytes(byte ^ 0xFF for byte in data)


def near(seconds: float) -> Any:
    """A time, but for rounding."""
    return pytest.approx(seconds)


def test_every_station_receives_a_request_after_its_last_character() -> None:
    async def play() -> tuple[Says, Says]:
        one, other = Says(), Says()
        port = await open_simulator([one, other], WIRE, Heard())
        port.write(REQUEST)
        await asyncio.sleep(1)
        return one, other

    for station in counted(play):
        assert station.heard == [(near(len(REQUEST) * C), REQUEST)]


def test_a_reply_comes_in_fifo_chunks_each_at_its_time() -> None:
    reply = bytes(range(40))

    async def play() -> Heard:
        ear = Heard(asyncio.get_running_loop().time)
        port = await open_simulator([Says(reply)], WIRE, ear, turnaround=0.004)
        port.write(REQUEST)
        await asyncio.sleep(1)
        return ear

    begin = len(REQUEST) * C + 0.004
    assert counted(play).pieces == [
        (near(begin + FIFO * C), reply[:FIFO]),
        (near(begin + 2 * FIFO * C), reply[FIFO : 2 * FIFO]),
        (near(begin + 40 * C), reply[2 * FIFO :]),
    ]


@pytest.mark.parametrize("stalled", range(40))
def test_the_pieces_of_a_reply_keep_their_order_when_the_machine_stalls(stalled: int) -> None:
    """Found by the soak: a process that stood still while it planned the pieces swapped two."""
    reply = bytes(range(100))

    async def play() -> bytes:
        loop, ear = asyncio.get_running_loop(), Heard()
        port = await open_simulator([Says(reply)], WIRE, ear)
        clock, looks = loop.time, itertools.count()
        loop.time = lambda: clock() + (0.1 if next(looks) > stalled else 0.0)  # type: ignore[method-assign]
        port.write(REQUEST)
        await asyncio.sleep(1)
        return ear.data

    assert counted(play) == reply


def test_two_frames_of_a_station_follow_each_other() -> None:
    async def play() -> bytes:
        ear = Heard()
        port = await open_simulator([Says(REPLY, REQUEST)], WIRE, ear)
        port.write(REQUEST)
        await asyncio.sleep(1)
        return ear.data

    assert counted(play) == REPLY + REQUEST


def test_a_slow_station_answers_later_by_its_delay() -> None:
    async def play() -> Heard:
        ear = Heard(asyncio.get_running_loop().time)
        port = await open_simulator([Says(b"A", delay=0.3)], WIRE, ear, turnaround=0.005)
        port.write(REQUEST)
        await asyncio.sleep(1)
        return ear

    assert counted(play).pieces == [(near((len(REQUEST) + 1) * C + 0.305), b"A")]


def test_two_writes_at_once_follow_each_other() -> None:
    async def play() -> Says:
        station = Says()
        port = await open_simulator([station], WIRE, Heard())
        port.write(REQUEST)
        port.write(REPLY)
        await asyncio.sleep(1)
        return station

    assert counted(play).heard == [
        (near(len(REQUEST) * C), REQUEST),
        (near(len(REQUEST + REPLY) * C), REPLY),
    ]


def test_two_stations_that_answer_at_once_spoil_each_other() -> None:
    async def play() -> Heard:
        ear = Heard()
        port = await open_simulator([Says(REPLY), Says(REPLY[:2])], WIRE, ear)
        port.write(REQUEST)
        await asyncio.sleep(1)
        return ear

    pieces = [data for _, data in counted(play).pieces]
    assert sorted(pieces) == sorted([turned(REPLY[:2]), turned(REPLY[:2]) + REPLY[2:]])


def test_writing_while_a_station_is_sending_spoils_both() -> None:
    reply = bytes(16)

    async def play() -> tuple[Heard, Says]:
        ear, station = Heard(), Says(reply)
        port = await open_simulator([station], WIRE, ear, turnaround=0.005)
        port.write(b"?")
        # In the middle of the reply's tenth character; two characters touch three.
        await asyncio.sleep(C + 0.005 + 9.5 * C)
        station.frames = []
        port.write(b"ab")
        await asyncio.sleep(1)
        return ear, station

    ear, station = counted(play)
    assert ear.data == bytes(9) + b"\xff" * 3 + bytes(4)
    assert [data for _, data in station.heard] == [b"?", turned(b"ab")]


def test_an_overlap_of_less_than_a_bit_is_not_noticed() -> None:
    async def play() -> tuple[Heard, Says]:
        ear, station = Heard(), Says(REPLY)
        port = await open_simulator([station], WIRE, ear, turnaround=0.0)
        port.write(b"?")
        await asyncio.sleep((1 + len(REPLY) - 0.05) * C)
        station.frames = []
        port.write(REQUEST)
        await asyncio.sleep(1)
        return ear, station

    ear, station = counted(play)
    assert ear.data == REPLY
    assert station.heard[1][1] == REQUEST


def test_a_late_reply_meets_the_next_request() -> None:
    async def play() -> tuple[Heard, Says]:
        ear, late = Heard(), Says(b"late", delay=0.1)
        port = await open_simulator([late], WIRE, ear, turnaround=0.0)
        port.write(b"?")
        await asyncio.sleep(0.1 - C / 2)  # it begins one and a half characters later
        late.frames = []
        port.write(b"next")
        await asyncio.sleep(1)
        return ear, late

    ear, late = counted(play)
    assert ear.data == turned(b"lat") + b"e"
    assert late.heard[1][1] == b"n" + turned(b"ext")


def test_a_request_right_after_a_reply_collides_with_nothing() -> None:
    async def play() -> list[bytes]:
        port: Port
        station = Says(REPLY)

        class Hasty(Heard):
            def received(self, data: bytes) -> None:
                super().received(data)
                if self.data.endswith(REPLY):
                    port.write(REQUEST)

        port = await open_simulator([station], WIRE, Hasty(), turnaround=0.0)
        port.write(REQUEST)
        await asyncio.sleep(10)
        return [data for _, data in station.heard]

    heard = counted(play)
    assert len(heard) > 100
    assert set(heard) == {REQUEST}


def test_not_paced_takes_no_time_and_keeps_the_order() -> None:
    async def play() -> tuple[Heard, Says]:
        ear, station = Heard(asyncio.get_running_loop().time), Says(bytes(300))
        port = await open_simulator([station], WIRE, ear, paced=False)
        for number in range(20):
            port.write(bytes([number]))
        await asyncio.sleep(0.001)
        return ear, station

    ear, station = counted(play)
    assert [data for _, data in station.heard] == [bytes([number]) for number in range(20)]
    assert ear.pieces == [(0.0, bytes(300))] * 20


def test_after_close_no_bytes_arrive_and_writing_fails() -> None:
    async def play() -> tuple[Heard, Says]:
        ear, station = Heard(), Says(REPLY)
        port = await open_simulator([station], WIRE, ear)
        port.write(REQUEST)
        await asyncio.sleep(len(REQUEST) * C + 0.006)
        await port.close()
        await port.close()
        with pytest.raises(LineDown):
            port.write(REQUEST)
        await asyncio.sleep(1)
        return ear, station

    ear, station = counted(play)
    assert (ear.data, ear.losses, len(station.heard)) == (b"", [], 1)


moments = st.lists(st.tuples(st.floats(0, 0.05), st.binary(min_size=1, max_size=20)), max_size=8)


@settings(max_examples=50)
@given(moments, st.lists(st.tuples(st.binary(max_size=40), st.floats(0, 0.05)), max_size=3))
def test_the_same_run_gives_the_same_bytes_and_loses_no_character(
    writes: list[tuple[float, bytes]], answers: list[tuple[bytes, float]]
) -> None:
    async def play() -> tuple[list[tuple[float, bytes]], list[list[tuple[float, bytes]]]]:
        ear = Heard(asyncio.get_running_loop().time)
        stations = [Says(*([frame] if frame else []), delay=delay) for frame, delay in answers]
        port = await open_simulator(stations, WIRE, ear)
        for pause, data in writes:
            await asyncio.sleep(pause)
            port.write(data)
        await asyncio.sleep(5)
        return ear.pieces, [station.heard for station in stations]

    first = counted(play)
    assert counted(play) == first
    replied = sum(len(frame) for frame, _ in answers) * len(writes)
    assert sum(len(data) for _, data in first[0]) == replied


async def test_a_simulator_is_not_opened_without_its_stations() -> None:
    with pytest.raises(ValueError, match="open_simulator"):
        await open_port(SimulatorAddress(), SerialSettings(), Heard())
