"""A station that loses what is sent too soon after its reply, before a running gateway."""

import asyncio
from contextlib import suppress
from pathlib import Path
from typing import Any

from gateway.stations.vigor import VigorStation
from tests.e2e.processes import PATIENCE, started, vigor_line, write_config
from tests.zenoh_peer import ZenohPeer, free_endpoint

NUMBERS = (100, 400, 700, 1000)
SAFE, NEEDED = 0.005, 0.003  # seconds
WRITE = b"61"  # the command of a write, at this place of a Vigor request
PLACE = slice(3, 5)


class Early:
    """A Vigor PLC on TCP. It misses the beginning of a request less than 3 ms after its reply."""

    def __init__(self) -> None:
        self.station = VigorStation(1)
        for number in NUMBERS:
            self.station.memory.write("D", number, [number])
        self.polls: list[float] = []  # seconds of silence before each
        self.writes: list[float] = []
        self.lost = 0

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        now, replied = asyncio.get_running_loop().time, 0.0
        with suppress(ConnectionError, asyncio.CancelledError):
            while data := await reader.read(256):
                silence = now() - replied
                (self.writes if data[PLACE] == WRITE else self.polls).append(silence)
                if silence < NEEDED:
                    self.lost += 1
                    data = data[3:]
                for reply in self.station.hear(data, now()):
                    replied = now()
                    writer.write(reply)
        writer.close()


async def test_a_request_that_is_lost_by_a_short_silence_costs_one_repeated_poll(
    tmp_path: Path,
) -> None:
    plc, zenoh = Early(), free_endpoint()
    tags: dict[str, Any] = {
        f"n{n}": {"address": f"D{n}", "every": "10ms", "heartbeat": "50ms"} for n in NUMBERS
    }
    tags["recipe"] = {"address": "D2000", "every": "1h", "write": True}
    listener = await asyncio.start_server(plc.serve, "127.0.0.1", 0)
    port = listener.sockets[0].getsockname()[1]
    line = vigor_line(f"tcp://127.0.0.1:{port}", tags)
    config = write_config(tmp_path / "config.yaml", zenoh, {"hall": line})
    async with listener:
        program = await asyncio.to_thread(started, config)
        with program:
            async with ZenohPeer("client", connect=[zenoh]) as client:
                values = await client.subscribe("plant/mixer/*")

                async def more(polls: int) -> None:
                    await values.next(lambda _: len(plc.polls) >= polls, timeout=PATIENCE)

                written = 0
                while not plc.lost:
                    written += 1
                    await client.get("plant/mixer/recipe/@set", b"%d" % written)
                    assert plc.station.memory.read("D", 2000) == [written]
                    await more(len(plc.polls) + 25)
                before = len(plc.polls)
                assert min(plc.polls[1:before]) < SAFE
                await more(before + 100)
                [status] = await client.get("plant/@gateway/demo/devices/mixer")
                good = [s for s in values.samples if s.json["quality"] == "good"]
    assert min(plc.writes) >= SAFE - 1e-4
    assert min(plc.polls[before:]) >= SAFE - 1e-4
    assert plc.lost == 1
    assert status.json["failures"] == {"silence": 1}
    assert status.json["standing"] == "up"
    assert status.json["silence"] == SAFE
    held = {(s.key, s.json["value"]) for s in good if not s.key.endswith("recipe")}
    assert held == {(f"plant/mixer/n{n}", n) for n in NUMBERS}
