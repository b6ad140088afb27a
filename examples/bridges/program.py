"""The options, the Zenoh session and the end of a bridge: shared by the bridges in this folder."""

import argparse
import asyncio
import json
import signal
import sys
from collections.abc import Coroutine
from contextlib import suppress
from pathlib import Path
from typing import Any

import zenoh


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def arguments(about: str | None) -> argparse.ArgumentParser:
    """The options of every bridge."""
    parser = argparse.ArgumentParser(
        description=about, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--connect",
        nargs="+",
        default=["tcp/127.0.0.1:7447"],
        metavar="ENDPOINT",
        help="the gateway or its router",
    )
    parser.add_argument("--zenoh", type=Path, metavar="FILE", help="a Zenoh file: user, TLS, …")
    parser.add_argument("--prefix", default="plant", help="of the gateways (default: plant)")
    return parser


async def opened(given: argparse.Namespace) -> zenoh.Session:
    """Opens a session, and waits for a router. Zenoh reconnects an open session by itself."""
    if given.zenoh:
        config = zenoh.Config.from_file(given.zenoh)
    else:
        config = zenoh.Config()
        config.insert_json5("connect/endpoints", json.dumps(given.connect))
        config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/retry", '{"period_init_ms": 500, "period_max_ms": 2000}')
    config.insert_json5("connect/timeout_ms", "1000")
    while True:
        try:
            return await asyncio.to_thread(zenoh.open, config)
        except zenoh.ZError as error:
            say(f"waiting for Zenoh: {error}")
            await asyncio.sleep(1.0)


def run(bridge: Coroutine[Any, Any, None]) -> None:
    """Runs it until Ctrl-C or SIGTERM, which cancel it."""

    async def until_signal() -> None:
        task = asyncio.ensure_future(bridge)
        with suppress(NotImplementedError):  # Windows
            asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, task.cancel)
        await task

    with suppress(KeyboardInterrupt, asyncio.CancelledError):
        asyncio.run(until_signal())
