"""The open port: its alarm, its echo, the silence before a request."""

import asyncio
from collections.abc import Callable

import pytest
from structlog.testing import capture_logs

from gateway.engine.device.station_silence import StationSilence
from gateway.errors import Garbled
from gateway.line.channel import KEPT, LONGEST_WAIT, NEVER, Alarm, Channel, Echo
from gateway.line.wire_log import WireLog
from gateway.planning.wire_timing import WireTiming
from tests.line.fake_port import FakePort
from tests.sim.virtual import now, on_virtual_time


def noting(rung: list[float], *again: float) -> Callable[[], float]:
    """Returns a callback that notes its calls in `rung` and asks for the times `again`."""
    answers = list(again)

    def look() -> float:
        rung.append(now())
        return answers.pop(0) if answers else NEVER

    return look


@on_virtual_time
async def test_the_alarm_goes_off_in_time_and_once() -> None:
    rung: list[float] = []
    start = now()
    Alarm(noting(rung)).by(start + 0.5)
    await asyncio.sleep(10)
    assert rung == [start + 0.5]


@on_virtual_time
async def test_the_alarm_goes_off_again_at_the_returned_times() -> None:
    rung: list[float] = []
    start = now()
    Alarm(noting(rung, start + 2, start + 3)).by(start + 0.5)
    await asyncio.sleep(10)
    assert rung == [start + 0.5, start + 2, start + 3]


@on_virtual_time
async def test_the_alarm_does_not_overlook_an_earlier_time() -> None:
    rung: list[float] = []
    alarm, start = Alarm(noting(rung)), now()
    alarm.by(start + 5)
    alarm.by(start + 1)
    await asyncio.sleep(10)
    assert rung == [start + 1]


@on_virtual_time
async def test_the_alarm_calls_the_last_callback_only() -> None:
    """The timer of the first keeps running; the last callback returns the next time."""
    before: list[float] = []
    rung: list[float] = []
    alarm, start = Alarm(noting(before)), now()
    alarm.by(start + 1)
    alarm.look = noting(rung, start + 5)
    await asyncio.sleep(10)
    assert before == []
    assert rung == [start + 1, start + 5]


# Echo

REQUEST, REPLY = b"\x01\x03\x00\x05", b"\x01\x03\x02\x04\xd2"


@pytest.mark.parametrize(
    ("heard", "found"),
    [
        (REQUEST + REPLY, True),
        (b"\x00" + REQUEST + REPLY, True),
        (REPLY, False),
        (REQUEST, None),  # an echo, or an acknowledgement that repeats the request
        (REQUEST + b"\x00\xff", None),  # too short for a reply: noise
        (b"\x01\x03\x00\x04" + REPLY, None),  # longer than the reply: a damaged echo
    ],
)
def test_the_echo_is_learned_from_what_arrived_until_the_reply(
    heard: bytes, found: bool | None
) -> None:
    echo = Echo("hall", None)
    assert echo.found is None
    echo.learn(REQUEST, heard, len(REPLY))
    assert echo.found is found
    assert not echo.strip


def test_an_echo_once_found_stays_found_until_a_reply_without_one() -> None:
    echo = Echo("hall", None)
    echo.learn(REQUEST, REQUEST + REPLY, len(REPLY))
    echo.learn(REQUEST, REQUEST, len(REPLY))
    assert echo.found is True
    echo.learn(REQUEST, REPLY, len(REPLY))
    assert echo.found is False


def test_an_echo_is_logged_once_for_each_line_and_not_at_every_opening() -> None:
    echo = Echo("hall", None)
    with capture_logs() as logs:
        for _ in range(3):
            echo.opened()
            assert echo.found is None
            echo.learn(REQUEST, REQUEST + REPLY, len(REPLY))
            assert echo.found is True
    assert [(entry["event"], entry["line"]) for entry in logs] == [("adapter echoes", "hall")]


def test_the_file_decides_before_any_reply() -> None:
    assert Echo("hall", True).strip
    assert Echo("hall", True).found is True
    assert not Echo("hall", False).strip
    assert Echo("hall", False).found is False


@pytest.mark.parametrize("before", [b"", b"\x00", b"\xff" * 40])
def test_the_echo_is_dropped_with_all_before_it(before: bytes) -> None:
    echo = Echo("hall", True)
    echo.sent(REQUEST)
    assert echo.without(before + REQUEST + REPLY) == REPLY
    assert echo.without(REPLY) == REPLY  # no second echo is expected


def test_the_echo_is_dropped_when_it_arrives_byte_by_byte() -> None:
    echo = Echo("hall", True)
    echo.sent(REQUEST)
    data = b"\x00" + REQUEST + REPLY
    assert b"".join(echo.without(bytes([byte])) for byte in data) == REPLY


def test_nothing_counts_until_the_echo_is_whole() -> None:
    echo = Echo("hall", True)
    echo.sent(REQUEST)
    assert echo.without(REPLY) == b""
    assert echo.early == REPLY
    assert echo.without(REPLY) == b""
    assert echo.early == REPLY + REPLY


def test_a_bounded_part_of_the_bytes_before_an_echo_is_kept() -> None:
    echo = Echo("hall", True)
    echo.sent(REQUEST)
    for _ in range(100):
        assert echo.without(b"\xaa" * 50) == b""
    assert len(echo.early) <= KEPT + len(REQUEST)
    assert echo.without(REQUEST + REPLY) == REPLY


def test_the_rest_of_an_echo_is_dropped_after_its_transaction() -> None:
    echo = Echo("hall", True)
    echo.sent(REQUEST)
    assert echo.without_rest(REQUEST[:2]) == b""
    assert echo.without_rest(REQUEST[2:] + b"\x02") == b"\x02"
    assert echo.without_rest(REQUEST) == REQUEST


def test_other_bytes_after_a_transaction_end_the_wait_for_the_echo() -> None:
    echo = Echo("hall", True)
    echo.sent(REQUEST)
    assert echo.without_rest(b"\x07" + REQUEST) == b"\x07" + REQUEST
    assert echo.without_rest(REQUEST) == REQUEST


# The silence before a request

SAFE = StationSilence(0.005, least=0.005)


def channel(baudrate: int = 9600) -> Channel:
    return Channel(FakePort(), WireTiming(baudrate, 10), WireLog(), Echo("hall", None))


@pytest.mark.parametrize("baudrate", [9600, 19200, 38400, 115200])
@on_virtual_time
async def test_the_silence_counts_from_the_last_busy_moment(baudrate: int) -> None:
    port, start = channel(baudrate), now()
    port.quiet_since = start + 0.004
    await port.quiet(SAFE)
    assert 0.009 - 1e-9 <= now() - start <= 0.0091


@on_virtual_time
async def test_bytes_in_a_shorter_silence_bring_the_safe_one_back_for_the_request_that_waits() -> (
    None
):
    port, silence = channel(), StationSilence(0.005, least=0.001)
    silence.keep(0.002)
    port.quiet_since = now()
    waiting = asyncio.create_task(port.quiet(silence))
    await asyncio.sleep(0.001)
    heard = port.quiet_since = now()
    silence.keep_safe(at_rest=True)
    await waiting
    assert now() - heard == pytest.approx(0.005)


@on_virtual_time
async def test_a_silence_that_is_over_is_not_waited_for() -> None:
    port, start = channel(), now()
    port.quiet_since = start - 0.005
    await port.quiet(SAFE)
    assert now() == start


class LateLoop:
    """Makes sleeps of the loop end up to a millisecond late, as event loops do."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        sleep = asyncio.sleep
        self.asked: list[float] = []

        async def late(seconds: float) -> None:
            self.asked.append(seconds)
            await sleep(seconds + (0.0009 if seconds else 0.0))

        monkeypatch.setattr(asyncio, "sleep", late)


@pytest.mark.parametrize(("baudrate", "late"), [(19200, 0.0009), (38400, 0.0)])
@on_virtual_time
async def test_above_19200_baud_the_last_millisecond_is_spent_at_the_clock(
    monkeypatch: pytest.MonkeyPatch, baudrate: int, late: float
) -> None:
    port, start = channel(baudrate), now()
    port.quiet_since = start
    loop = LateLoop(monkeypatch)
    await port.quiet(SAFE)
    assert now() - start == pytest.approx(0.005 + late, abs=5e-5)
    assert (loop.asked.count(0) > 1) == (late == 0.0)


@pytest.mark.parametrize("baudrate", [9600, 115200])
@on_virtual_time
async def test_a_line_that_is_never_quiet_is_garbled_after_a_second(baudrate: int) -> None:
    port, start = channel(baudrate), now()

    async def babble() -> None:
        while True:
            port.quiet_since = now()
            await asyncio.sleep(0.002)

    port.quiet_since = start
    babbling = asyncio.create_task(babble())
    with pytest.raises(Garbled, match="never quiet, nothing was sent"):
        await port.quiet(SAFE)
    babbling.cancel()
    assert LONGEST_WAIT <= now() - start < LONGEST_WAIT + 0.02


@on_virtual_time
async def test_a_pause_delays_the_next_request() -> None:
    port = channel()
    sent = port.quiet_since = now()
    port.pause(0.1)
    await port.quiet(SAFE)
    assert now() - sent == pytest.approx(0.105)
