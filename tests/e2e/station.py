"""Simulated Vigor PLCs in a process of their own, controlled by commands.

`python -m tests.e2e.station 1,2 pty LINK` or `… tcp [HOST:]PORT`. It prints `ready`, then executes
commands from its standard input and prints `ok …` after each:

    mute 1            works, but its replies are lost           speak 1     replies again
    hole 1 D 700      the address does not exist                fill 1 D 700
    set 1 D 100 5     as the program of the PLC does            get 1 D 500
    count 1 D 10      a register that counts ten a second       delay 1 0.3 replies late
    deaf / hear       closes and opens the port
"""

import asyncio
import sys

from gateway.planning.wire_timing import WireTiming, character_bits
from gateway.simulator.serve import Served, serve_on_pty, serve_on_tcp
from gateway.stations.vigor import VigorStation

WIRE = WireTiming(19200, character_bits("7E1"))


class Plant:
    """The stations and their port."""

    def __init__(self, numbers: list[int], kind: str, where: str) -> None:
        self.stations = {number: VigorStation(number) for number in numbers}
        self._kind = kind
        self._where = where
        self._served: Served | None = None

    async def open(self) -> None:
        stations = list(self.stations.values())
        if self._kind == "pty":
            self._served = await serve_on_pty(stations, WIRE, self._where)
        else:
            host, _, port = self._where.rpartition(":")
            self._served = await serve_on_tcp(stations, WIRE, host or "127.0.0.1", int(port))

    async def close(self) -> None:
        if self._served is not None:
            await self._served.close()

    async def execute(self, words: list[str]) -> object:
        match words:
            case ["deaf"]:
                await self.close()
                return ""
            case ["hear"]:
                await self.open()
                return ""
            case [verb, number, *rest]:
                return _execute(self.stations[int(number)], verb, rest)
        raise ValueError(words)


def _execute(station: VigorStation, verb: str, rest: list[str]) -> object:
    match verb, *rest:
        case ["mute"]:
            station.mute = True
        case ["speak"]:
            station.mute = False
        case ["hole", area, number]:
            station.memory.holes.add((area, int(number)))
        case ["fill", area, number]:
            station.memory.holes.discard((area, int(number)))
        case ["set", area, number, value]:
            station.memory.write(area, int(number), [int(value)])
        case ["get", area, number]:
            return station.memory.read(area, int(number))[0]
        case ["count", area, number]:
            station.memory.animate(area, int(number), lambda now: int(now * 10) & 0x7FFF)
        case ["delay", seconds]:
            station.delay = float(seconds)  # type: ignore[attr-defined]  # the simulated wire reads it
        case _:
            raise ValueError((verb, rest))
    return ""


async def main(numbers: str, kind: str, where: str) -> None:
    plant = Plant([int(number) for number in numbers.split(",")], kind, where)
    await plant.open()
    print("ready", flush=True)
    commands = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(
        lambda: asyncio.StreamReaderProtocol(commands), sys.stdin
    )
    async for line in commands:
        print("ok", await plant.execute(line.decode().split()), flush=True)
    await plant.close()


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
