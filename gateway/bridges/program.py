"""The session, the messages and the end of a bridge."""

import asyncio
import json
import signal
import sys
from collections.abc import Coroutine, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import zenoh

from gateway.errors import ConfigError

CANCEL_EVERY = 3.0  # seconds


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
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/retry", '{"period_init_ms": 500, "period_max_ms": 2000}')
        config.insert_json5("connect/timeout_ms", "1000")
    except zenoh.ZError as error:
        raise ConfigError(f"{gateways.file or ', '.join(gateways.connect)}: {error}") from None
    while True:
        try:
            return await asyncio.to_thread(zenoh.open, config)
        except zenoh.ZError as error:
            say(f"waiting for Zenoh: {error}")
            await asyncio.sleep(1.0)


def run(bridge: Coroutine[Any, Any, None]) -> None:
    """Runs it until Ctrl-C or SIGTERM, which cancel it.

    Again after a pause: `asyncio.wait_for` of Python 3.11 may lose a cancellation, and libraries
    use it.
    """

    async def until_signal() -> None:
        task, loop = asyncio.ensure_future(bridge), asyncio.get_running_loop()

        def stop() -> None:
            task.cancel()
            loop.call_later(CANCEL_EVERY, stop)

        with suppress(NotImplementedError):  # Windows
            loop.add_signal_handler(signal.SIGTERM, stop)
        await task

    try:
        with suppress(KeyboardInterrupt, asyncio.CancelledError):
            asyncio.run(until_signal())
    except ExceptionGroup as failed:  # of the tasks of a bridge: the first one ended the others
        raise failed.exceptions[0] from None
