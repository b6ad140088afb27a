"""The gateway's modem port against tcpser, a modem emulator of other authors.

Debian 10 has it as a package; elsewhere it is built from source, and found on the PATH.
"""

import asyncio
import shutil
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import pytest

from gateway.errors import CallEnded
from gateway.simulator.serve import serve_on_tcp
from gateway.stations.vigor import VigorStation
from gateway.transport import (
    ModemAddress,
    ModemSettings,
    SerialSettings,
    TcpAddress,
    open_modem,
)
from gateway.transport.modem import ModemPort
from tests.conftest import forbidden
from tests.e2e.processes import Program, free_port, listens, until
from tests.e2e.station import WIRE
from tests.serving.easy_link import frame
from tests.transport.ends import RecordingReceiver

READ = frame(1, "51", "1C0002")  # D0
GOOD, NOWHERE = "26204393", "5"


class Bench:
    """tcpser, a PLC that it dials, and the port of the gateway."""

    def __init__(self, port: ModemPort, receiver: RecordingReceiver, calls: int) -> None:
        self.port = port
        self.receiver = receiver
        self.calls = calls  # the TCP port that callers connect to

    async def heard(self, size: int) -> bytes:
        await self.receiver.until(lambda receiver: len(receiver.data) >= size)
        return self.receiver.data


@asynccontextmanager
async def tcpser(number: str = GOOD, *, answers: bool = False) -> AsyncIterator[Bench]:
    program = shutil.which("tcpser")
    if program is None:
        forbidden("tcpser is not installed: Debian has had no package of it since version 10")
    plc, modem, calls = free_port(), free_port(), free_port()
    station = VigorStation(1)
    station.memory.write("D", 0, [250])
    served = await serve_on_tcp([station], WIRE, "127.0.0.1", plc)
    book = (f"-n{GOOD}=127.0.0.1:{plc}", f"-n{NOWHERE}=127.0.0.1:1")
    receiver = RecordingReceiver()
    settings = ModemSettings(number=number, guard=1.2, idle=60.0)
    try:
        where = ("-v", f"127.0.0.1:{modem}", "-s", "9600", "-p", f"127.0.0.1:{calls}")
        with Program(program, *where, *book):
            until(lambda: listens(modem), "tcpser listens")
            port = await open_modem(
                *(ModemAddress(TcpAddress("127.0.0.1", modem)), SerialSettings(), settings),
                receiver,
                answers=answers,
            )
            try:
                yield Bench(port, receiver, calls)
            finally:
                await port.close()
    finally:
        await served.close()


async def test_a_plc_is_dialled_asked_and_hung_up() -> None:
    async with tcpser() as bench:
        for _ in range(2):
            bench.receiver.data = b""
            await bench.port.dial()
            bench.port.write(READ)
            assert await bench.heard(14) == b"\x06015100FA00\x0311"
            await bench.port.hang_up()
            with pytest.raises(CallEnded, match="no call"):
                bench.port.write(READ)
        assert bench.receiver.losses == []


async def test_a_number_without_an_answer_fails_in_the_words_of_the_modem() -> None:
    async with tcpser(NOWHERE) as bench:
        with pytest.raises(CallEnded, match=r"BUSY|NO CARRIER|NO ANSWER"):
            await bench.port.dial()


async def test_a_caller_is_answered_and_its_hang_up_is_the_end_of_the_call() -> None:
    async with tcpser(answers=True) as bench:
        _, caller = await asyncio.open_connection("127.0.0.1", bench.calls)
        await connected(bench, lambda: caller.write(READ))
        assert READ in bench.receiver.data
        caller.close()
        await bench.receiver.until(lambda receiver: bool(receiver.losses))
        assert "NO CARRIER" in str(bench.receiver.losses[0])
        assert b"NO CARRIER" not in bench.receiver.data


async def connected(bench: Bench, say: Callable[[], None]) -> None:
    """Repeats a request until the modem has answered the call and passes it on."""
    async with asyncio.timeout(300):
        while not bench.receiver.data.endswith(READ):
            say()
            await asyncio.sleep(0.2)
