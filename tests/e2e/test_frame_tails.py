"""A weight whose tail looks like another one, and a gateway that is stopped as its port opens."""

import asyncio
import math
import os
import signal
import socket
import time
from contextlib import suppress
from itertools import product
from pathlib import Path

from tests.e2e.processes import started, write_config
from tests.zenoh_peer import Received, Subscription, ZenohPeer, free_endpoint

QUIET = 0.05  # seconds of silence after which a byte begins a frame
STOPPED = 0.3  # seconds
FRAME, TAIL = b"+001234.5\r\n", b"34.5\r\n"
WEIGHT = {"match": r"\+?(?P<w>[0-9]{1,6}\.[0-9])", "fields": {"w": {"type": "decimal"}}}
DELAYS = 0.0, 0.002, 0.005, 0.01, 0.02  # from the open port to the stop
HEADS = b"", FRAME[: -len(TAIL)]


def accepted(server: socket.socket) -> tuple[socket.socket, float]:
    """Returns a connection, and a time before which it was not there."""
    before = -math.inf
    while True:
        try:
            connection, _ = server.accept()
        except BlockingIOError:
            before = time.monotonic()
            time.sleep(0.001)
        else:
            return connection, before


def stop_within_a_frame(
    pid: int, server: socket.socket, head: bytes, delay: float
) -> tuple[socket.socket, bool]:
    """Returns the connection. False: the machine was slow, and the tail came after a silence."""
    connection, before = accepted(server)
    connection.sendall(head)
    time.sleep(delay)
    os.kill(pid, signal.SIGSTOP)
    connection.sendall(TAIL)
    in_time = time.monotonic() - before < QUIET - 0.01
    time.sleep(STOPPED)
    os.kill(pid, signal.SIGCONT)
    return connection, in_time


def is_good(sample: Received) -> bool:
    return bool(sample.json["quality"] == "good")


async def has_come(seen: Subscription) -> bool:
    """Returns True when there is a good value; after a silence, in which none came, False."""
    with suppress(TimeoutError):
        await seen.next(is_good, timeout=2 * QUIET)
    return any(map(is_good, seen.samples))


async def test_the_tail_of_a_weight_is_no_weight_in_a_gateway_that_is_stopped(
    tmp_path: Path,
) -> None:
    endpoint = free_endpoint()
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setblocking(False)
        scale = {
            "protocol": "frames",
            "framing": {"terminator": "<CR><LF>"},
            "listen": {"weight": WEIGHT},
            "tags": {"weight": {"address": "w"}},
        }
        port = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        file = write_config(
            tmp_path / "c.yaml", endpoint, {"hall": {"port": port, "devices": {"scale": scale}}}
        )
        with started(file) as program:
            async with ZenohPeer("client", connect=[endpoint]) as client:
                seen = await client.subscribe("plant/scale/weight")
                left = list(product(HEADS, DELAYS))
                while left:
                    connection, in_time = await asyncio.to_thread(
                        stop_within_a_frame, program.pid, server, *left[-1]
                    )
                    with connection:
                        while not await has_come(seen):
                            connection.sendall(FRAME)
                    if in_time:
                        left.pop()
                        values = {one.json["value"] for one in seen.samples if is_good(one)}
                        assert values == {1234.5}
                    await seen.next(lambda sample: not is_good(sample))
                    seen.forget()
