"""A served RTU line whose adapter returns replies late, and a panel that writes at once again."""

import asyncio
from itertools import groupby
from pathlib import Path

from tests.attacks.test_served_lines import Wire, rtu
from tests.e2e.processes import started, write_config
from tests.zenoh_peer import Subscription, ZenohPeer, free_endpoint

ECHO, PAUSE, SILENT = 0.06, 0.004, 1.0  # seconds; the last one until the panel asks again
CHANGES = 9, 7, 9, 7, 9, 7
READ, BUSY = rtu("01 03 0064 0001"), rtu("01 86 06")
DEVICE = "plant/@gateway/demo/devices/plc"


def write(value: int) -> bytes:
    return rtu(f"01 06 0064 {value:04x}")


class Panel:
    """The panel on the wire, and the adapter, which returns what the gateway sends."""

    def __init__(self, wire: Wire) -> None:
        self._wire = wire
        self._loop = asyncio.get_running_loop()
        self._received = b""
        self._news = asyncio.Event()
        self._flying = 0  # echoes
        self.returned = set[bytes]()
        self.asked = self.told = 0

    def hear(self, data: bytes) -> None:
        self._flying += 1
        self._loop.call_later(ECHO, self._return, data)
        self._received += data
        self._news.set()

    def _return(self, data: bytes) -> None:
        self._flying -= 1
        self.returned.add(data)
        self._wire.say(data)
        self._news.set()

    async def ask(self, request: bytes, reply: bytes) -> None:
        """Asks until this reply has come."""
        while not await self._asked(request, reply):
            await asyncio.sleep(PAUSE)
        self.told += 1
        await asyncio.sleep(PAUSE)

    async def _asked(self, request: bytes, reply: bytes) -> bool:
        self.asked += 1
        self._received = b""
        self._wire.say(request)
        try:
            async with asyncio.timeout(SILENT):
                while reply not in self._received and BUSY not in self._received:
                    self._news.clear()
                    await self._news.wait()
        except TimeoutError:
            return False
        return reply in self._received

    async def until_returned(self) -> None:
        while self._flying:
            self._news.clear()
            await self._news.wait()


def runs(seen: Subscription) -> list[int]:
    values = [one.json["value"] for one in seen.samples if one.json["value"]]
    return [value for value, _ in groupby(values)]


async def test_a_panel_that_writes_at_once_again_on_a_line_with_a_late_echo(
    tmp_path: Path,
) -> None:
    endpoint = free_endpoint()
    with Wire() as wire:
        tags = {"order": {"address": "holding:100"}}
        plc = {"protocol": "modbus-rtu", "station": 1, "accept": ["holding:100"], "tags": tags}
        line = {"port": wire.path, "baudrate": 19200, "serve": True, "devices": {"plc": plc}}
        panel = Panel(wire)
        with started(write_config(tmp_path / "config.yaml", endpoint, {"wire": line})) as program:
            program.says("line open")
            with wire.heard_by(panel.hear):
                async with ZenohPeer("client", connect=[endpoint]) as client:
                    seen = await client.subscribe("plant/plc/order")
                    while panel.told < 40 or BUSY not in panel.returned:
                        await panel.ask(write(7), write(7))
                    for _ in range(5):  # reads show the delay, also if the process stood still
                        await panel.ask(READ, rtu("01 03 02 0007"))
                        await panel.until_returned()
                    for value in CHANGES:
                        for _ in range(10):
                            await panel.ask(write(value), write(value))
                    await panel.until_returned()
                    await panel.ask(READ, rtu("01 03 02 0007"))
                    await panel.until_returned()
                    [device] = await client.get(DEVICE)
                    await seen.until(lambda seen: len(runs(seen)) > len(CHANGES))
                    assert runs(seen) == [7, *CHANGES]  # no old write is done again
                    assert device.json["writes"] < panel.asked + 10  # no storm
                    assert panel.asked < 2 * panel.told  # nor is every second write ignored
