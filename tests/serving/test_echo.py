"""A served line beside its own echo, and beside a master that repeats itself at once."""

import asyncio
import heapq
from typing import cast

import pytest

from gateway.parts.serving.conversation import Conversation
from gateway.transport import Port
from tests.serving.bench import Bench
from tests.serving.test_modbus_serial import READ, VALUE, ascii_frame, bench, rtu
from tests.sim.virtual import on_virtual_time

WRITE = rtu("01 06 0004 0007")
BUSY = rtu("01 86 06")


def on_the_wire(
    made: Bench, requests: list[tuple[float, bytes]], echo: float | None
) -> list[tuple[float, bytes]]:
    """Returns the replies with their times. Each one returns after `echo` seconds."""
    coming = [(at, number, data) for number, (at, data) in enumerate(requests)]
    heapq.heapify(coming)
    replies: list[tuple[float, bytes]] = []
    last = 0.0
    while coming and len(replies) < 200:
        at, _, data = heapq.heappop(coming)
        heard = made.hear(data, after=at - last)
        last = at
        if heard.reply:
            replies.append((at + heard.delay, heard.reply))
            if echo is not None:
                heapq.heappush(coming, (at + heard.delay + echo, len(replies) + 1000, heard.reply))
    return replies


@pytest.mark.parametrize("delay", [0.002, 0.06, 0.3, 0.9, 1.5, 4.0])
def test_a_late_echo_is_never_answered_as_a_request(delay: float) -> None:
    """Only the first one is doubtful: "busy" shows that the adapter echoes, and writes nothing."""
    made = bench()
    other = rtu("01 06 0004 0009")
    requests = [(5.0 * n, WRITE if n % 2 else other) for n in range(1, 9)]
    replies = [reply for _, reply in on_the_wire(made, requests, delay)]
    assert made.written == [{"setpoint": 7 if n % 2 else 9} for n in range(1, 9)]
    assert replies.count(BUSY) == 1
    assert len(replies) == len(requests) + 1


@pytest.mark.parametrize("delay", [0.002, 0.06, 0.3])
def test_a_read_shows_the_echo_before_any_write(delay: float) -> None:
    made = bench()
    requests = [(1.0, READ), *((2.0 + n, WRITE) for n in range(5))]
    assert [one for _, one in on_the_wire(made, requests, delay)] == [VALUE] + [WRITE] * 5


def test_the_fastest_echo_counts_where_delays_differ() -> None:
    made = bench()
    for delay in (0.02, 0.3):
        assert made.ask(READ, after=5) == VALUE
        assert made.ask(VALUE, after=delay) == b""
    assert made.ask(WRITE, after=5) == WRITE
    assert made.ask(WRITE, after=0.02) == b""


def test_echoes_on_their_way_keep_their_order() -> None:
    """The master writes on after each reply: no value of before is written again."""
    made, other = bench(), rtu("01 06 0004 0009")
    assert len(on_the_wire(made, [(1.0, READ)], 0.08)) == 1
    requests = [(3.0, other), (3.03, WRITE), (3.075, WRITE)]
    assert [reply for _, reply in on_the_wire(made, requests, 0.08)] == [other, WRITE, WRITE]
    assert made.written == [{"setpoint": 9}, {"setpoint": 7}, {"setpoint": 7}]


def test_a_request_before_the_echo_can_have_arrived_is_answered() -> None:
    """The delay counts from the reply, 32 ms after its request at this speed."""
    made = bench(baudrate=1200)
    assert len(on_the_wire(made, [(1.0, READ)], 0.08)) == 1
    replies = on_the_wire(made, [(3.0, WRITE), (3.065, WRITE)], 0.08)
    assert [reply for _, reply in replies] == [WRITE, WRITE]
    assert replies[1][0] == pytest.approx(3.097, abs=0.001)


class Written(list[bytes]):
    """A port that keeps what is written."""

    write = list.append


@on_virtual_time
async def test_an_echo_in_the_pause_before_a_reply_does_not_cancel_it() -> None:
    """It is no next request."""
    made, port = bench(), Written()
    talk = Conversation(made.line)
    talk.opened(cast(Port, port))
    other = rtu("01 06 0004 0009")
    for received in ((READ,), (VALUE,), (WRITE,), (other, WRITE), (other,)):
        for data in received:
            talk.received(data)
        await asyncio.sleep(0.02)
    assert (port, made.line.unsent) == ([VALUE, WRITE, other], 0)
    talk.received(WRITE)
    talk.received(READ)
    await asyncio.sleep(0.02)
    assert (port[3:], made.line.unsent) == ([VALUE], 1)


def test_an_ascii_echo_is_no_request_either() -> None:
    made, write = bench("modbus-ascii"), ascii_frame("01 06 0004 0007")
    requests = [(1.0, ascii_frame("01 03 0000 0001")), *((2.0 + n, write) for n in range(5))]
    assert len(on_the_wire(made, requests, 0.06)) == 6
    assert made.written == [{"setpoint": 7}] * 5


def test_a_master_that_writes_the_same_value_at_once_is_always_answered() -> None:
    made = bench()
    replies = [made.ask(WRITE, after=0.012) for _ in range(400)]
    assert replies[1] == BUSY  # it repeats the request
    assert replies.count(WRITE) >= 396
    assert b"" not in replies
    assert made.written == [{"setpoint": 7}] * replies.count(WRITE)


def test_an_echo_that_begins_later_is_learned_and_one_that_ends_is_forgotten() -> None:
    made = bench()
    assert len(on_the_wire(made, [(1.0, READ), (3.0, WRITE)], None)) == 2
    events = len(made.written)
    replies = on_the_wire(made, [(5.0, WRITE)], 0.06)  # another adapter
    assert len(replies) < 12
    assert replies[-1][1] == BUSY
    for _ in range(5):
        assert made.ask(WRITE, after=5) == WRITE
        assert made.ask(WRITE, after=0.06) == b""
    assert len(made.written) - events < 16
    for _ in range(4):  # the first adapter again
        assert made.ask(READ, after=2) == VALUE
    assert made.ask(READ, after=2) == VALUE
    assert [made.ask(WRITE, after=0.06) for _ in range(4)] == [WRITE] * 4


def test_with_echo_in_the_file_nothing_is_learned() -> None:
    told = bench(echo=True)
    assert [told.ask(WRITE, after=0.5) for _ in range(4)] == [WRITE, b"", WRITE, b""]
    never = bench(echo=False)
    assert [never.ask(WRITE, after=0.01) for _ in range(4)] == [WRITE] * 4


@pytest.mark.parametrize("delay", [0.06, 1.5, 8.0, 30.0])
def test_a_refusal_that_returns_is_no_request(delay: float) -> None:
    """Its function is that of no master: an answer would return, and so on for ever."""
    refused = rtu("01 03 0999 0001")
    assert [reply for _, reply in on_the_wire(bench(), [(1.0, refused)], delay)] == [
        rtu("01 83 02")
    ]


def test_a_late_echo_that_ends_is_forgotten() -> None:
    made = bench()
    assert len(on_the_wire(made, [(5.0, WRITE)], 1.5)) == 2
    assert made.ask(WRITE, after=10) == WRITE
    assert made.ask(WRITE, after=1.5) == b""
    for _ in range(6):
        assert made.ask(READ, after=5) == VALUE
    assert [made.ask(WRITE, after=1.5) for _ in range(4)] == [WRITE] * 4


@pytest.mark.parametrize("request_", [WRITE, rtu("01 03 0999 0001")])
def test_two_gateways_with_one_number_do_not_answer_each_other_for_ever(request_: bytes) -> None:
    twins, passed = (bench(), bench()), 0
    said = twins[0].ask(request_)
    while said and passed < 100:
        passed += 1
        said = twins[passed % 2].ask(said, after=0.02)
    assert passed < 5
