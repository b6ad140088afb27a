"""The session, the messages and the end of a bridge."""

import asyncio
import json
import signal
import sys
from collections.abc import Coroutine, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import zenoh

from gateway.ending import LastResort
from gateway.errors import ConfigError

CANCEL_EVERY, LOOK_EVERY = 4.0, 0.5  # seconds


class Gateways(NamedTuple):
    """The gateways that a bridge serves: all below a prefix. `file`: a Zenoh file instead of
    `connect`, with user and TLS."""

    connect: Sequence[str]
    file: Path | None
    prefix: str


# The extras of pyproject.toml.
_INSTALLED_BY = {
    "bridge opcua": "pip install asyncua",
    "bridge mqtt": "pip install aiomqtt protobuf",
    "archive in PostgreSQL": "pip install psycopg psycopg-binary",
    "archive in Parquet": "pip install pyarrow",
}


def say(text: str) -> None:
    """Prints one line, whatever names and reasons of other programs hold."""
    line = "".join(one if one.isprintable() else "\ufffd" for one in text)
    print(line, file=sys.stderr, flush=True)


@contextmanager
def packages_of(name: str) -> Iterator[None]:
    """Imports a bridge or a store. Raises `ConfigError` where the packages of its extra lack."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("gateway"):
            raise
        raise ConfigError(
            f"{name} needs the package {error.name}, which is not installed: "
            f"{_INSTALLED_BY[name]}, with the pip of the gateway"
        ) from None


async def opened(gateways: Gateways) -> zenoh.Session:
    """Opens a session, and waits for a router. Zenoh reconnects an open session by itself. Raises
    `ConfigError` for a bad file or endpoint."""
    try:
        if gateways.file:
            config = zenoh.Config.from_file(gateways.file)
        else:
            config = zenoh.Config()
            config.insert_json5("connect/endpoints", json.dumps(list(gateways.connect)))
            config.insert_json5("scouting/multicast/enabled", "false")
            config.insert_json5("transport/unicast/open_timeout", "5000")  # satellites need 3 s
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/retry", '{"period_init_ms": 500, "period_max_ms": 2000}')
        # Each endpoint once: with a time for all Zenoh waits at the first.
        config.insert_json5("connect/timeout_ms", "0")
    except zenoh.ZError as error:
        raise ConfigError(f"{gateways.file or ', '.join(gateways.connect)}: {error}") from None
    while True:
        try:
            return await asyncio.to_thread(zenoh.open, config)
        except zenoh.ZError as error:
            say(f"waiting for Zenoh: {error}")
            await asyncio.sleep(1.0)


def run(bridge: Coroutine[Any, Any, None]) -> None:
    """Runs it until Ctrl-C or SIGTERM, which cancel it. `LastResort` ends the process after it.

    The bridge has its own thread: signals are heard also while a call of a library stands still
    there. First only the bridge is cancelled, which ends its tasks in their order. After
    `CANCEL_EVERY` all that is left is cancelled, again and again: `asyncio.wait_for` of Python 3.11
    may lose a cancellation, libraries use it, and a group of tasks cancels its own only once.
    """
    loop = asyncio.new_event_loop()
    task = loop.create_task(bridge)
    last = LastResort(loop)

    async def ended() -> None:
        await task

    def served() -> None:
        with suppress(asyncio.CancelledError), asyncio.Runner(loop_factory=lambda: loop) as runner:
            runner.run(ended())

    def cancel(*tasks: asyncio.Task[Any]) -> None:
        for one in tasks or asyncio.all_tasks(loop):
            one.cancel()
        loop.call_later(CANCEL_EVERY, cancel)

    def stop(*_signal: object) -> None:
        if last.start():
            with suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(cancel, task)

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with ThreadPoolExecutor(1, "bridge") as thread:
            ending = thread.submit(served)
            while not ending.done():
                wait([ending], LOOK_EVERY)  # a signal just before does not end it
            ending.result()
    except ExceptionGroup as failed:  # of the tasks of a bridge: the first one ended the others
        raise failed.exceptions[0] from None
    finally:
        last.cancel()
        for number, handler in before.items():
            signal.signal(number, handler)
