"""A wire on a pty at a real baud rate, in a process of its own: `python -m benchmarks.paced_wire`.

Stations reply after their turnaround, and each character arrives at its time at this baud rate.
The process prints the path of the pty, and serves until its standard input closes. Then it prints
characters, turnarounds and elapsed time as JSON.
"""

import ctypes
import json
import os
import select
import sys
import time
import tty
from collections.abc import Sequence
from dataclasses import asdict, dataclass

from gateway.stations.station import Station

PR_SET_TIMERSLACK = 29
FIFO = 16  # characters a UART hands over at once


@dataclass(slots=True)
class Passed:
    """Seconds and characters, from the second request to the end of the last reply.

    The first request is the short probe of the line.
    """

    exchanges: int = 0
    characters: int = 0
    turnarounds: float = 0.0
    elapsed: float = 0.0


def serve(stations: Sequence[Station], character: float, turnaround: float) -> None:
    ctypes.CDLL(None).prctl(PR_SET_TIMERSLACK, 1, 0, 0, 0)  # wake up to the microsecond
    master, slave = os.openpty()
    tty.setraw(slave)
    print(os.ttyname(slave), flush=True)
    passed = Passed()
    started, heard = 0.0, 0
    while True:
        ready = select.select([master, sys.stdin], [], [])[0]
        if sys.stdin in ready:
            break
        arrived = time.monotonic()
        request = os.read(master, 4096)
        heard += 1
        if heard == 2:
            started = arrived
        spoken = arrived + len(request) * character
        replies = [reply for s in stations for reply in s.hear(request, time.monotonic())]
        if not replies:
            continue
        begin = spoken + turnaround
        ended = _send(master, b"".join(replies), begin, character)
        if heard == 1:
            continue
        passed.exchanges += 1
        passed.characters += len(request) + sum(map(len, replies))
        passed.turnarounds += turnaround
        passed.elapsed = ended - started
    print(json.dumps(asdict(passed)), flush=True)


def _send(master: int, data: bytes, begin: float, character: float) -> float:
    """Sends pieces of a FIFO's size, each when its last character ends. Returns the last end."""
    due = begin
    for start in range(0, len(data), FIFO):
        piece = data[start : start + FIFO]
        due = begin + (start + len(piece)) * character
        while (wait := due - time.monotonic()) > 0:
            time.sleep(wait)
        os.write(master, piece)
    return due


def main() -> None:
    from benchmarks.bus_use import SETTINGS

    name, baud, turnaround = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
    setting = SETTINGS[name]
    serve([setting.station()], setting.bits / baud, turnaround)


if __name__ == "__main__":
    main()
