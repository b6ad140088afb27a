"""A link that was too full becomes quiet: its subscribers must not keep old values as good."""

import asyncio
from pathlib import Path
from typing import Any

from gateway.northbound.publishing.republish import _SETTLE_TIME
from tests.attacks.tcp_peer import peer
from tests.e2e.paced_link import UNLIMITED, paced_link
from tests.e2e.processes import started, write_config
from tests.zenoh_peer import Subscription, ZenohPeer, free_endpoint

TAGS = 600
NARROW = 240_000.0  # bits a second: a tenth of what the values need


class Counters:
    """A Modbus TCP device: all its registers hold one number, which counts until it stops."""

    def __init__(self) -> None:
        self.value = 0
        self.stopped = False

    async def serve(
        self, _number: int, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        while True:
            request = await reader.readexactly(12)
            words = int.from_bytes(request[10:12], "big")
            self.value += not self.stopped
            body = request[6:8] + bytes([2 * words]) + (self.value % 0x8000).to_bytes(2) * words
            writer.write(request[:4] + len(body).to_bytes(2) + body)


def stale(received: Subscription, value: int) -> int:
    newest = [sample.json["value"] for sample in received.latest().values()]
    return TAGS - newest.count(value)


async def test_no_value_stays_stale_after_a_link_was_too_full(tmp_path: Path) -> None:
    plc = Counters()
    endpoint = free_endpoint()
    listen = f"{endpoint}#so_sndbuf=8192"  # otherwise the system keeps 4 MB on their way
    async with (
        peer(plc.serve) as port,
        paced_link(endpoint) as link,
    ):
        tags = {f"t{n}": {"address": f"holding:{n}"} for n in range(TAGS)}
        device = {"protocol": "modbus-tcp", "station": 1, "tags": tags}
        line = {"port": f"tcp://127.0.0.1:{port}", "devices": {"plc": device}}
        file = write_config(tmp_path / "c.yaml", listen, {"net": line}, defaults={"every": "200ms"})
        with await asyncio.to_thread(started, file):
            async with (
                ZenohPeer("client", connect=[link.endpoint]) as client,
                ZenohPeer("client", connect=[endpoint]) as beside,
            ):
                received = await client.subscribe("plant/**", advanced=True)
                await received.until(lambda of: len(of.latest()) == TAGS)
                link.rate = NARROW

                def congested(status: Any) -> bool:
                    return bool(status["congested"])

                await beside.get_until("plant/@gateway/demo/zenoh", congested)
                plc.stopped = True
                value = plc.value
                link.rate = UNLIMITED
                try:
                    await received.until(lambda of: stale(of, value) == 0, timeout=300)
                finally:
                    print("stale:", stale(received, value), "of", TAGS)


def quiet(file: Path, endpoint: str, tags: int, **zenoh: str) -> Path:
    """Writes the configuration of a plant whose values are read once."""
    plc = {
        "protocol": "vigor",
        "station": 1,
        "tags": {f"t{n}": {"address": f"D{5000 + n}"} for n in range(tags)},
    }
    line = {"port": "simulator", "devices": {"plc": plc}}
    settings = {"prefix": "plant", "listen": [endpoint], **zenoh}
    return write_config(file, endpoint, {"hall": line}, defaults={"every": "1h"}, zenoh=settings)


async def test_every_value_is_published_within_the_time_of_refresh(tmp_path: Path) -> None:
    """It bounds any loss, also one that no slow put has shown."""
    endpoint = free_endpoint()
    file = quiet(tmp_path / "c.yaml", endpoint, 50, refresh="1s")
    with await asyncio.to_thread(started, file):
        async with ZenohPeer("client", connect=[endpoint]) as client:
            values = await client.subscribe("plant/**")
            await values.until(lambda of: len(of.latest()) == 50)
            values.forget()
            await values.until(lambda of: len(of.latest()) == 50)


async def test_a_link_that_flaps_does_not_publish_everything_each_time(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    file = quiet(tmp_path / "c.yaml", endpoint, 1)
    flaps = 12
    async with paced_link(endpoint) as link:
        with await asyncio.to_thread(started, file, "--log-level", "debug") as program:
            async with (
                ZenohPeer("client", connect=[endpoint]) as beside,
                ZenohPeer("client", connect=[link.endpoint]),
            ):
                values = await beside.subscribe("plant/plc/t0")
                for _ in range(flaps):
                    said = len(program.lines)
                    await link.cut()
                    await asyncio.to_thread(program.says, "Zenoh link up", after=said)
                    await asyncio.sleep(_SETTLE_TIME)  # each return alone would publish again
                assert 0 < len(values.samples) <= 8
