"""pymodbus' own server as a peer: `pymodbus_server.py FRAMER DEVICE`, `... FRAMER tcp PORT` or
`... FRAMER udp PORT`.

With `VENDOR MODEL` at the end it tells these by function 43/14. Unit 1: coils and discrete inputs,
every third on; holding register n holds n, input register n 1000 + n; 10000 of each. Prints "ready"
when it listens.
"""

import asyncio
import sys
from typing import Any, cast

from pymodbus import FramerType, ModbusDeviceIdentification
from pymodbus.server import ModbusSerialServer, ModbusTcpServer, ModbusUdpServer
from pymodbus.simulator import DataType, SimData, SimDevice

COUNT = 10000


def device() -> SimDevice:
    third = [SimData(0, values=[n % 3 == 0 for n in range(COUNT)], datatype=DataType.BITS)]
    holding = [SimData(0, values=list(range(COUNT)), datatype=DataType.REGISTERS)]
    inputs = [SimData(0, values=list(range(1000, 1000 + COUNT)), datatype=DataType.REGISTERS)]
    return SimDevice(id=1, simdata=(third, list(third), holding, inputs))


async def main(framer: str, *where: str) -> None:
    kind = FramerType[framer.upper()]
    names = dict(zip(("VendorName", "ModelName"), where[2:], strict=False))
    identity: Any = cast("Any", ModbusDeviceIdentification)(info_name=names) if names else None
    server: ModbusTcpServer | ModbusUdpServer | ModbusSerialServer
    if where[0] in ("tcp", "udp"):
        kinds: dict[str, type[ModbusTcpServer | ModbusUdpServer]] = {
            "tcp": ModbusTcpServer,
            "udp": ModbusUdpServer,
        }
        server = kinds[where[0]](
            [device()],
            framer=kind,
            address=("127.0.0.1", int(where[1])),
            ignore_missing_devices=True,
            identity=identity,
        )
    else:
        server = ModbusSerialServer(
            [device()],
            framer=kind,
            port=where[0],
            identity=identity,
            baudrate=19200,
            parity="N",
            ignore_missing_devices=True,
        )
    await server.serve_forever(background=True)
    print("ready", flush=True)
    await asyncio.Event().wait()


asyncio.run(main(*sys.argv[1:]))
