"""A line that only listens beside one that polls; its trace, recorded and replayed."""

import asyncio
from contextlib import suppress
from pathlib import Path

import pytest

from gateway.cli.line.replay import replay
from tests.attacks.slave import crc
from tests.e2e.processes import plc_gateway, slowed, started, write_config
from tests.zenoh_peer import Subscription, ZenohPeer, free_endpoint

BAUD = 9600
ENOUGH = 8  # values


class Bus:
    """A wire with one slave. The first connection is the master; every other one hears all."""

    def __init__(self) -> None:
        self.count = 0  # the register of the slave grows with every read
        self.spoken = b""  # by those that only listen
        self.listening = asyncio.Event()
        self._ears: list[asyncio.StreamWriter] = []

    async def master(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await self.listening.wait()
        while request := await _read(reader):
            self._pass_on(request)
            self.count += 1
            asked = request[5]  # registers
            body = bytes((1, 3, 2 * asked)) + self.count.to_bytes(2, "big") * asked
            reply = body + crc(body)
            writer.write(reply)
            self._pass_on(reply[:3])
            self._pass_on(reply[3:])
        writer.close()

    async def ear(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._ears.append(writer)
        self.listening.set()
        while data := await _read(reader):
            self.spoken += data
        self._ears.remove(writer)
        writer.close()

    def _pass_on(self, data: bytes) -> None:
        for ear in self._ears:
            ear.write(data)


async def _read(reader: asyncio.StreamReader) -> bytes:
    with suppress(ConnectionError, asyncio.CancelledError):
        return await reader.read(256)
    return b""


def values(heard: Subscription, device: str) -> list[int]:
    key = f"plant/{device}/count"
    found = (sample.json["value"] for sample in heard.samples if sample.key == key)
    return [value for value in found if value is not None]


async def test_a_listen_only_line_learns_what_another_master_reads(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bus, endpoint, recording = Bus(), free_endpoint(), tmp_path / "recording"
    polled = await asyncio.start_server(bus.master, "127.0.0.1", 0)
    heard = await asyncio.start_server(bus.ear, "127.0.0.1", 0)

    def line(server: asyncio.Server, name: str, **settings: object) -> dict[str, object]:
        tags = {"count": {"address": "holding:7", "every": "100ms", "write": True}}
        device = {"protocol": "modbus-rtu", "station": 1, "tags": tags}
        port = f"tcp://127.0.0.1:{server.sockets[0].getsockname()[1]}"
        return {"port": port, "baudrate": BAUD, "devices": {name: device}, **settings}

    lines = {"wire": line(polled, "meter"), "ear": line(heard, "copy", listen_only=True)}
    config = write_config(tmp_path / "config.yaml", endpoint, lines)
    async with polled, heard:
        with await asyncio.to_thread(started, config) as gateway:
            async with ZenohPeer("client", connect=[endpoint]) as client:
                news = await client.subscribe("plant/**")
                await news.until(lambda told: len(values(told, "copy")) >= ENOUGH)
                [refused] = await client.get("plant/copy/count/@set", b"5")
                record = (
                    "trace",
                    config,
                    "ear",
                    "--for",
                    f"{slowed(0.6):.1f}s",
                    "--record",
                    recording,
                )
                assert (await asyncio.to_thread(plc_gateway, *record)).code == 0
            assert gateway.end() == 0
    copied, polled_values = values(news, "copy"), values(news, "meter")
    assert len({*copied} & {*polled_values}) >= ENOUGH // 2  # a busy machine conflates some
    assert copied == sorted(copied)
    assert not refused.ok
    assert "line ear is listen-only: the gateway sends nothing on it" in refused.json["reason"]
    assert bus.spoken == b""
    replay([recording], config, check=True)
    words = capsys.readouterr().out.splitlines()[-1].split()
    assert int(words[0]) > 2
    assert words[1:] == ["values", "as", "recorded,", "0", "others,", "0", "not", "learned"]
