"""Replies of served stations at full load: `python -m benchmarks.served`.

One gateway serves two lines (Modbus RTU at 19200 baud, on ptys) and polls a third that is asked for
more than it carries. Two masters in processes of their own read and write 60 words without rest:
their next request follows as soon as the characters would have left a wire. It prints how long a
reply took after the last character of its request, how long until a written value was on Zenoh in
this process, and how late a sleeping process of this machine wakes: that is part of both.
"""

import argparse
import json
import os
import select
import struct
import tempfile
import time
import tty
from collections.abc import Sequence
from multiprocessing import Pipe, Process
from multiprocessing.connection import Connection
from pathlib import Path

import zenoh

from gateway.protocols.checksums import crc16
from tests.e2e.processes import gateway, listens, until
from tests.zenoh_peer import free_endpoint

CHARACTER = 11 / 19200
WORDS = 60
SILENCE = 4 * CHARACTER
PAUSE = 0.02  # seconds without a reply that count as lost


def plant(endpoint: str, ports: Sequence[str]) -> dict[str, object]:
    def served(port: str) -> dict[str, object]:
        tags = {f"w{n}": {"address": f"holding:{n}"} for n in range(WORDS)}
        accept = [f"holding:0..holding:{WORDS - 1}"]
        plc = {"protocol": "modbus-rtu", "station": 1, "accept": accept, "tags": tags}
        devices = {f"panel-{ports.index(port)}": plc}
        return {"port": port, "serve": True, "baudrate": 19200, "devices": devices}

    tags = {f"t{n}": {"address": f"D{n * 40}", "every": "20ms"} for n in range(100)}
    polled = {"protocol": "vigor", "station": 1, "tags": tags}
    lines = {f"served-{n}": served(port) for n, port in enumerate(ports)}
    hall = {"port": "simulator", "baudrate": 19200, "devices": {"mixer": polled}}
    return {"zenoh": {"prefix": "served", "listen": [endpoint]}, "lines": {**lines, "hall": hall}}


def framed(body: bytes) -> bytes:
    return body + crc16(body)


def master(fd: int, seconds: float, results: Connection) -> None:
    """Asks until the time is over, then sends the times of its replies, of its writes and the
    number of replies that did not come."""
    read, reply = framed(struct.pack(">BBHH", 1, 3, 0, WORDS)), 5 + 2 * WORDS
    took, written, lost, turn = [], {}, 0, 0
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        turn += 1
        request, size = read, reply
        if turn % 2:
            words = struct.pack(f">{WORDS}H", *[turn % 65536] * WORDS)
            request = framed(struct.pack(">BBHHB", 1, 16, 0, WORDS, 2 * WORDS) + words)
            size = 8
        time.sleep(len(request) * CHARACTER + SILENCE)
        os.write(fd, request)
        sent = time.monotonic()
        heard = b""
        while len(heard) < size and select.select([fd], [], [], PAUSE if heard else 0.5)[0]:
            if not heard:
                took.append(time.monotonic() - sent)
            heard += os.read(fd, 1024)
        lost += len(heard) < size
        if turn % 2:
            written[turn % 65536] = sent
        time.sleep(len(heard) * CHARACTER + SILENCE)
    results.send((took, written, lost))


def lateness(seconds: float) -> list[float]:
    """Returns how late this process woke from sleeps of 2 ms."""
    late, end = [], time.monotonic() + seconds
    while (now := time.monotonic()) < end:
        time.sleep(0.002)
        late.append(time.monotonic() - now - 0.002)
    return late


def shown(times: Sequence[float]) -> str:
    row = sorted(times)
    at = [row[len(row) // 2], row[int(len(row) * 0.99)], row[-1]]
    return "median {:.1f} ms, p99 {:.1f} ms, longest {:.1f} ms".format(*(1e3 * one for one in at))


def main() -> None:
    parser = argparse.ArgumentParser(description="replies of served stations at full load")
    parser.add_argument("--seconds", type=float, default=30.0)
    seconds = parser.parse_args().seconds
    ends = [os.openpty() for _ in range(2)]
    for _, slave in ends:
        tty.setraw(slave)
    endpoint = free_endpoint()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "c.yaml"
        file.write_text(json.dumps(plant(endpoint, [os.ttyname(slave) for _, slave in ends])))
        with gateway("run", file, "--log-level", "error") as program:
            until(lambda: listens(int(endpoint.rpartition(":")[2])), "the gateway listens")
            config = zenoh.Config()
            config.insert_json5("mode", '"client"')
            config.insert_json5("connect/endpoints", json.dumps([endpoint]))
            arrived: list[tuple[float, bytes]] = []
            with zenoh.open(config) as session:
                subscriber = session.declare_subscriber(
                    "served/panel-0/w59",
                    lambda sample: arrived.append((time.monotonic(), sample.payload.to_bytes())),
                )
                time.sleep(1.0)
                pipes = [Pipe() for _ in ends]
                masters = [
                    Process(target=master, args=(fd, seconds, pipe))
                    for (fd, _), (_, pipe) in zip(ends, pipes, strict=True)
                ]
                for process in masters:
                    process.start()
                late = lateness(seconds)
                found = [pipe.recv() for pipe, _ in pipes]
                for process in masters:
                    process.join()
                subscriber.undeclare()  # type: ignore[no-untyped-call]  # Zenoh's stub lacks it
            program.end()
    for number, (took, _, lost) in enumerate(found):
        print(f"served-{number}: {len(took)} replies, {lost} lost: {shown(took)}")
    written = found[0][1]
    samples = [(at, json.loads(data)["value"]) for at, data in arrived]
    delays = [at - written[value] for at, value in samples if value in written]
    print(f"a written value on Zenoh: {len(delays)} of {len(written)}: {shown(delays)}")
    print(f"a process that slept woke late: {shown(late)}")


if __name__ == "__main__":
    main()
