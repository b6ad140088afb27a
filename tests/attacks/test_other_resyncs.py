"""At the running gateway: a station that is silent about the loopback comes online, and stays.

Each resync was by a loopback, so the station was offline for ever.
"""

import asyncio
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.attacks.slave import Slave, program_on
from tests.serving.test_computer_link import block, request

NUMBERS = (10, 100, 200)
STATION = "05"


class Clone:
    """A Computer Link PLC in format 4, by the manual: WR alone. Each word holds its number."""

    mute = False
    loopbacks = 0

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(ConnectionError, asyncio.IncompleteReadError):
            while asked := (await reader.readuntil(b"\r\n")).decode():
                assert asked.encode() == request(asked[1:-4], 4)
                station, command, area = asked[1:5], asked[5:7], asked[8:-4]
                assert station == STATION + "FF"
                self.loopbacks += command == "TT"
                if command == "WR" and not self.mute:
                    first, count = int(area[1:5]), int(area[5:], 16)
                    assert area[0] == "D"
                    words = "".join(f"{n:04X}" for n in range(first, first + count))
                    writer.write(block(station + words, 4))


@dataclass
class Meter(Slave):
    """A Modbus slave that has function 03 alone."""

    loopbacks: int = 0

    def _replies(self, request: bytes) -> Sequence[bytes]:
        self.loopbacks += request[1] == 8
        return super()._replies(request)


async def test_stations_that_are_silent_about_loopbacks_come_online_and_stay(
    tmp_path: Path,
) -> None:
    """Both at once, on two lines, because they mostly wait."""
    link = {"protocol": "computer-link", "frame_format": 4, "station": int(STATION)}
    modbus = {"protocol": "modbus-rtu", "diagnostics": True, "station": 1}
    await asyncio.gather(
        _comes_online_and_stays(Clone(), tmp_path / "link", link, "D{}", {}),
        _comes_online_and_stays(
            Meter(lambda n: True), tmp_path / "modbus", modbus, "holding:{}", {"echo": False}
        ),
    )


async def _comes_online_and_stays(
    station: Clone | Meter,
    folder: Path,
    device: dict[str, Any],
    address: str,
    line: dict[str, Any],
) -> None:
    folder.mkdir()
    tags = {f"n{n}": {"address": address.format(n), "type": "uint16"} for n in NUMBERS}
    device |= {"reply_timeout": "200ms", "late_guard": "50ms", "tags": tags}
    async with program_on(station, folder, {"plc": device}, line) as (_, client):
        values = await client.subscribe("plant/plc/*")

        def all_are(quality: str) -> bool:
            last = values.latest().values()
            return [one.json["quality"] for one in last] == [quality] * len(NUMBERS)

        await values.until(lambda _: all_are("good"))
        station.mute = True
        await values.until(lambda _: all_are("bad"))
        station.mute = False
        await values.until(lambda _: all_are("good"))
        assert station.loopbacks
    good = {(one.key, one.json["value"]) for one in values.samples if one.json["value"] is not None}
    assert good == {(f"plant/plc/n{n}", n) for n in NUMBERS}
