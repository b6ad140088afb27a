"""pymodbus's asyncio client on the slaves of `benchmarks.scenarios`, on uvloop where it is there.

`python -m benchmarks.scenario_peer PORT LINES UNITS TAGS SECONDS` does the same as
`scenario_peer.js`.
"""

import asyncio
import json
import sys
from collections import Counter
from struct import Struct

from pymodbus.client import AsyncModbusTcpClient

from gateway.transport.loop import new_event_loop

_MOST = 62  # numbers of a request


async def _line(port: int, units: int, tags: int, every: float, counted: Counter[str]) -> None:
    client = AsyncModbusTcpClient("127.0.0.1", port=port)
    await client.connect()
    known: dict[tuple[int, int], tuple[int, ...]] = {}
    loop = asyncio.get_running_loop()
    due = loop.time()
    while True:
        for unit in range(1, units + 1):
            for first in range(0, tags, _MOST):
                count = min(_MOST, tags - first)
                reply = await client.read_holding_registers(
                    2 * first, count=2 * count, device_id=unit
                )
                words = Struct(f">{2 * count}H").pack(*reply.registers)
                values = Struct(f">{count}I").unpack(words)
                before = known.get((unit, first), (None,) * count)
                counted["changed"] += sum(a != b for a, b in zip(values, before, strict=True))
                counted["read"] += count
                known[unit, first] = values
        due += every
        counted["late"] += loop.time() > due
        await asyncio.sleep(max(0.0, due - loop.time()))


async def _main(port: int, lines: int, sizes: tuple[int, int], every: float) -> None:
    counted = Counter[str]({"read": 0, "changed": 0, "late": 0})
    async with asyncio.TaskGroup() as tasks:
        reads = [tasks.create_task(_line(port + n, *sizes, every, counted)) for n in range(lines)]
        while await asyncio.to_thread(sys.stdin.readline):
            print(json.dumps(counted), flush=True)
        for task in reads:
            task.cancel()


if __name__ == "__main__":
    _port, _lines, _units, _tags = map(int, sys.argv[1:5])
    with asyncio.Runner(loop_factory=new_event_loop) as _runner:
        _runner.run(_main(_port, _lines, (_units, _tags), float(sys.argv[5])))
