"""A Computer Link PLC that writes the first values of a joint write, and then refuses it."""

import asyncio
from collections import Counter
from pathlib import Path

from tests.e2e.processes import started, write_config
from tests.protocols.computer_link_peer import Peer
from tests.zenoh_peer import ZenohPeer, free_endpoint

WORDS = [f"D{500 + 40 * n}" for n in range(8)]


class PartPeer(Peer):
    """A PLC on TCP that counts what is written. It writes two values of WT, then sends NAK 06."""

    def __init__(self) -> None:
        super().__init__(5, 4, True)
        self.commands: Counter[str] = Counter()
        self.puts: Counter[str] = Counter()
        self.closed = asyncio.Event()

    def obey(self, command: str, area: str) -> bytes:
        self.commands[command] += 1
        if command != "WT":
            return super().obey(command, area)
        for entry in self.entries(area, 9, 10)[:2]:
            self.put([entry[:5]], entry[5:], words=True)
        return self.nak("06")

    def put(self, names: list[str], data: str, words: bool) -> bytes:
        self.puts.update(names)
        return super().put(names, data, words)

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while True:
                writer.write(self.hear(await reader.readuntil(b"\r\n")))
        except (asyncio.IncompleteReadError, ConnectionError):
            writer.close()
        finally:
            self.closed.set()


async def test_no_value_is_written_twice_and_no_end_is_claimed_that_is_not_known(
    tmp_path: Path,
) -> None:
    plc, endpoint = PartPeer(), free_endpoint()
    server = await asyncio.start_server(plc.serve, "127.0.0.1", 0)
    number = server.sockets[0].getsockname()[1]
    tags = {word: {"address": word, "write": True, "every": "60s"} for word in WORDS}
    device = {"protocol": "computer-link", "station": 5, "frame_format": 4, "tags": tags}
    line = {"port": f"tcp://127.0.0.1:{number}", "baudrate": 9600, "devices": {"oven": device}}
    config = write_config(tmp_path / "config.yaml", endpoint, {"hall": line})
    async with server:
        with await asyncio.to_thread(started, config) as gateway:
            await asyncio.to_thread(gateway.says, "device online")
            async with ZenohPeer("client", connect=[endpoint]) as client:
                told = await client.subscribe("plant/@gateway/demo/writes")
                for n, word in enumerate(WORDS):  # faster than the wire
                    await client.put(f"plant/oven/{word}/@set", str(7 + n).encode())
                await told.until(lambda h: len(h.samples) == len(WORDS))
        await plc.closed.wait()
    assert plc.commands["WT"] > 0
    assert max(plc.puts.values()) == 1
    for sample in told.samples:
        end, word = sample.json, sample.json["key"].rpartition("/")[2]
        held = plc.devices.get(word.replace("D", "D0")) == end["value"]
        assert end["outcome"] == ("written" if held else "unclear")
