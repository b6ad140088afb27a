"""Stations served to other programs, reached through the gateway's own ports."""

import asyncio
import os
from functools import partial
from pathlib import Path

import pytest

from gateway.errors import LineDown
from gateway.planning.wire_timing import NETWORK_BAUD, WireTiming
from gateway.simulator.serve import serve_on_pty, serve_on_tcp
from gateway.transport import Port, SerialSettings, open_port, parse_port
from tests.transport.ends import PATIENCE, Heard, Says, listening
from tests.vectors import vectors

REQUEST, REPLY = (vector.frame for vector in vectors("vigor")[:2])
WIRE = WireTiming(19200, 10)
SEVEN_EVEN = SerialSettings(19200, "7E1")


async def reach(address: str, ear: Heard) -> Port:
    return await open_port(parse_port(address), SEVEN_EVEN, ear)


async def test_stations_on_a_pty_answer_at_the_wires_speed() -> None:
    ear, loop = Heard(), asyncio.get_running_loop()
    served = await serve_on_pty([Says(REPLY)], WIRE, None)
    port = await reach(served.address, ear)
    begin = loop.time()
    port.write(REQUEST)
    await ear.until(lambda e: len(e.data) >= len(REPLY))
    assert ear.data == REPLY
    assert loop.time() - begin >= len(REQUEST + REPLY) * WIRE.character + 0.005
    await port.close()
    await served.close()


async def test_a_pty_serves_one_program_after_another_and_reports_its_end() -> None:
    served = await serve_on_pty([Says(REPLY)], WIRE, None)
    for _ in range(2):
        ear = Heard()
        port = await reach(served.address, ear)
        port.write(REQUEST)
        await ear.until(lambda e: len(e.data) >= len(REPLY))
        await port.close()
    last = Heard()
    port = await reach(served.address, last)
    await served.close()
    await served.close()
    await last.until(lambda e: bool(e.losses))
    await port.close()


async def test_a_pty_without_a_reader_does_not_stop_the_line() -> None:
    loop, troubles = asyncio.get_running_loop(), []
    loop.set_exception_handler(lambda _, context: troubles.append(context))
    station = Says(bytes(3000))
    served = await serve_on_pty([station], WireTiming(NETWORK_BAUD), None, turnaround=0.0)
    user = os.open(served.address, os.O_RDWR | os.O_NOCTTY)
    async with asyncio.timeout(PATIENCE):
        for asked in range(20):
            os.write(user, REQUEST)
            while len(station.heard) <= asked:
                await asyncio.sleep(0.001)
        await asyncio.sleep(0.01)  # the last reply is through
    assert troubles == []
    os.close(user)
    await served.close()


async def test_a_link_to_the_pty_replaces_an_old_one_and_is_removed_with_the_pty(
    tmp_path: Path,
) -> None:
    link = tmp_path / "ttyPLC"
    link.symlink_to("/dev/pts/of-a-run-that-crashed")
    served = await serve_on_pty([Says(REPLY)], WIRE, str(link))
    assert served.address == str(link)
    ear = Heard()
    port = await reach(served.address, ear)
    port.write(REQUEST)
    await ear.until(lambda e: len(e.data) >= len(REPLY))
    await port.close()
    await served.close()
    assert not link.is_symlink()


async def test_a_link_replaced_by_another_program_is_not_removed(tmp_path: Path) -> None:
    link = tmp_path / "ttyPLC"
    first = await serve_on_pty([], WIRE, str(link))
    second = await serve_on_pty([], WIRE, str(link))
    await first.close()
    assert link.is_symlink()
    await second.close()


async def test_a_file_in_the_links_place_is_kept(tmp_path: Path) -> None:
    link = tmp_path / "ttyPLC"
    link.write_text("precious")
    with pytest.raises(LineDown, match="File exists"):
        await serve_on_pty([], WIRE, str(link))
    assert link.read_text() == "precious"


async def test_every_connection_to_a_tcp_port_receives_the_one_line_behind_it() -> None:
    served = await serve_on_tcp([Says(REPLY)], WIRE, "127.0.0.1", 0)
    ears = Heard(), Heard()
    ports = [await reach(served.address, ear) for ear in ears]
    begin = asyncio.get_running_loop().time()
    # Only what has been accepted hears: ask by each in turn.
    ports[0].write(REQUEST)
    await ears[0].until(lambda e: len(e.data) >= len(REPLY))
    assert asyncio.get_running_loop().time() - begin >= len(REQUEST + REPLY) * WIRE.character
    ports[1].write(REQUEST)
    await ears[1].until(lambda e: e.data.endswith(REPLY))
    await ears[0].until(lambda e: len(e.data) >= 2 * len(REPLY))
    for port in ports:
        await port.close()
    await served.close()


class Echo(Says):
    """Answers with what it was asked."""

    def hear(self, data: bytes, now: float) -> list[bytes]:
        return [data]


def ends_with(last: bytes, heard: Heard) -> bool:
    return heard.data.endswith(last)


async def test_network_stations_answer_each_connection_alone() -> None:
    served = await serve_on_tcp([Echo()], WireTiming(NETWORK_BAUD), "127.0.0.1", 0, paced=False)
    ears = Heard(), Heard()
    ports = [await reach(served.address, ear) for ear in ears]
    for who, question in ((0, b"a"), (1, b"b"), (0, b"c")):
        ports[who].write(question)
        await ears[who].until(partial(ends_with, question))
    assert (ears[0].data, ears[1].data) == (b"ac", b"b")
    await ports[0].close()
    await served.close()
    await served.close()
    await ears[1].until(lambda e: bool(e.losses))
    await ports[1].close()


async def test_a_tcp_port_in_use_has_a_clear_message() -> None:
    with listening() as taken:
        host, number = taken.getsockname()
        with pytest.raises(LineDown, match=f"{host}:{number}: this address is in use"):
            await serve_on_tcp([], WIRE, host, number)


async def test_no_such_tcp_port_is_line_down() -> None:
    with pytest.raises(LineDown):
        await serve_on_tcp([], WIRE, "127.0.0.1", 70_000)
