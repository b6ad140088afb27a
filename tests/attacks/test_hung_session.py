"""A session that is connected and passes nothing: a device server that lost its serial side."""

import asyncio

import pytest
from structlog.testing import capture_logs

from tests.attacks.tcp_peer import Readings, made_line, modbus_tcp, peer, running, tcp_reply


async def test_a_hung_session_is_reopened(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first session answers twice, then nothing passes; only a new session helps."""
    monkeypatch.setattr("gateway.engine.results.line_silence.FIRST", 1.0)

    async def hangs(
        number: int, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        if number == 0:
            for _ in range(2):
                writer.write(tcp_reply(await reader.readexactly(12)))
            await reader.read(-1)
        await modbus_tcp(reader, writer)

    sink = Readings()
    async with peer(hangs) as number:
        line = made_line(number, ["holding:7"], sink)
        with capture_logs() as logs:
            async with running(line):
                await sink.until(lambda: line.engine.record.opened == 2)
                await sink.more_good(3)
                assert line.engine.is_open
                why = line.engine.record.last_trouble
    assert "no station has replied for 1 s" in why
    assert [log["why"] for log in logs if log["event"] == "line down"] == [why]
