"""Modbus TCP devices that take one request at a time, with `window: 8` in the file."""

import asyncio

import pytest
from structlog.testing import capture_logs

from gateway.engine.results.pipelining import LOST
from tests.attacks.tcp_peer import Readings, made_line, peer, running, tcp_reply

TAGS = [f"holding:{1000 * n}" for n in range(8)]


async def first_only(
    number: int, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
) -> None:
    """Reads a buffer, replies to the first request in it, and forgets the rest."""
    while data := await reader.read(1024):
        writer.write(tcp_reply(data[:12]))


async def deaf_while_busy(
    number: int, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
) -> None:
    """Takes 10 ms for a reply, and drops what arrives meanwhile."""
    while data := await reader.read(12):
        await asyncio.sleep(0.01)
        writer.write(tcp_reply(data))
        while True:
            try:
                async with asyncio.timeout(0):
                    await reader.read(4096)
            except TimeoutError:
                break


@pytest.mark.parametrize("device", [first_only, deaf_while_busy])
async def test_a_device_that_takes_one_request_at_a_time_is_asked_one_at_a_time(
    device: object,
) -> None:
    sink = Readings()
    async with peer(device) as number:  # type: ignore[arg-type]
        line = made_line(number, TAGS, sink, window=8)
        [plc] = line.engine.devices
        with capture_logs() as logs:
            async with running(line):
                await sink.until(lambda: plc.one_at_a_time and sink.good > 0)
                failures = sum(plc.record.failures.values())
                await sink.more_good(200)
                # With several at a time most are lost; a busy machine is late now and then.
                assert sum(plc.record.failures.values()) - failures < 20
                assert len(sink.last) == 8
                assert sink.good > 200
                said = plc.diagnosis()
    assert said == "It takes one request at a time, not 8: set `window: 1`"
    assert [log["why"] for log in logs if log["event"] == "window reduced"] == [LOST]
