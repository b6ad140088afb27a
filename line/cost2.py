import sys
import time

sys.path.insert(0, ".")
from tests.attacks.test_pouring_peer import NOISE, STARTS

from gateway.errors import Garbled
from gateway.protocols.checksums import crc16
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.modbus import ModbusAscii, ModbusRtu, ModbusTcp
from gateway.protocols.vigor import Vigor

f = bytes([1, 3, 2, 0, 7])
F = f + crc16(f)
for D in (ModbusTcp, ModbusRtu, ModbusAscii, Vigor, ComputerLink):
    for what, data in (
        ("noise", NOISE),
        ("starts", STARTS),
        ("zeros", bytes(16384)),
        ("stx", b"\x02" * 16384),
        ("enq", b"\x05" * 16384),
        ("colon", b":" * 16384),
        ("ascii", b"\x02" + b"0" * 16384),
        ("0103", b"\x01\x03" * 8192),
        ("0110", b"\x01\x10" * 8192),
        ("frames", F * 2340),
        ("mbap", bytes([0, 1, 0, 0, 0, 4, 1, 3, 1, 0]) * 1600),
    ):
        c = D(station=1).codec()
        t = time.process_time()
        worst = 0
        n = 0
        g = 0
        fr = 0
        big = (data * 8)[:131072]
        for i in range(0, len(big), 4096):
            a = time.process_time()
            try:
                fr += len(c.feed(big[i : i + 4096]))
            except Garbled:
                g += 1
                c = D(station=1).codec()
            n += 4096
            worst = max(worst, time.process_time() - a)
            if time.process_time() - t > 2:
                break
        t = time.process_time() - t
        print(
            f"{D.__name__:14} {what:7} {n / t / 1000:10.0f} kB/s  worst chunk {worst * 1000:8.1f} ms  {n} bytes {fr} frames {g} garbled",
            flush=True,
        )
