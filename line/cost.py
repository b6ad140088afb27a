import sys
import time

sys.path.insert(0, ".")
from tests.attacks.test_pouring_peer import NOISE, STARTS

from gateway.engine.engine import Engine
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.modbus import ModbusAscii, ModbusRtu, ModbusTcp
from gateway.protocols.registry import *
from gateway.protocols.vigor import Vigor
from tests.sim.bench import WIRE
from tests.sim.plant import made_device

for D in (ModbusTcp, ModbusRtu, ModbusAscii, Vigor, ComputerLink):
    devs = [made_device(f"p{n}", D(station=n), WIRE, D(station=n).timing, ()) for n in range(1, 9)]
    for what, data in (
        ("noise", NOISE),
        ("starts", STARTS),
        ("zeros", bytes(16384)),
        ("stx", b"\x02" * 16384),
        ("enq", b"\x05" * 16384),
        ("colon", b":" * 16384),
        ("ascii", b"\x02" + b"0" * 16384),
    ):
        e = Engine("x", devs, WIRE)
        e.opened(0.0)
        t = time.process_time()
        worst = 0
        n = 0
        big = (data * 8)[:131072]
        for i in range(0, len(big), 4096):
            a = time.process_time()
            e.received(big[i : i + 4096], 0.0, 0)
            n += 4096
            worst = max(worst, time.process_time() - a)
            if time.process_time() - t > 3:
                break
        t = time.process_time() - t
        print(
            f"{D.__name__:14} {what:7} {n / t / 1000:10.0f} kB/s  worst chunk {worst * 1000:8.1f} ms",
            flush=True,
        )
