"""The `bench` command: a page on this machine from an unknown line to tags on Zenoh."""

import asyncio
import signal
import socket
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from gateway.cli.bench.api import BenchApi, Entry
from gateway.cli.config.demo import free_port
from gateway.cli.config.new import LISTEN
from gateway.cli.line.logs import LogFormat, LogLevel, set_up
from gateway.config.sheets.grid import MOST_BYTES
from gateway.ending import stop_event
from gateway.errors import ConfigError
from gateway.parts.web.connections import Connections
from gateway.parts.web.guard import Guard
from gateway.parts.web.languages import catalogue_route
from gateway.parts.web.listener import Listener, files_of
from gateway.parts.web.server import ASSETS
from gateway.parts.web.settings import WebSection

_FOLDER = Path(__file__).parent / "assets"
_SHARED = {"/page.css", "/dom.js", "/language.js", "/icon.svg"}  # with the page of the gateway
_HOST = "127.0.0.1"
_ADDRESS = "Bench: http://127.0.0.1:{}/#{} (works once; Ctrl-C ends the bench)"


def bench(
    file: Annotated[
        Path, typer.Argument(metavar="[FILE]", help="The YAML file; it is made if there is none.")
    ] = Path("plant.yaml"),
    at: Annotated[
        int, typer.Option(min=0, max=65535, help="the port of the page (default: a free one)")
    ] = 0,
) -> None:
    """Open a page on this machine: scan a line, look at registers, name tags, import, apply.

    Only this machine reaches it, with an address that works once. It writes nothing but FILE.
    """
    try:
        is_there = file.resolve().parent.is_dir()
    except OSError as error:
        raise ConfigError(f"{file.parent}: {error.strerror}") from None
    if not is_there:
        raise ConfigError(f"there is no folder {file.parent}")
    try:
        socket.create_server((_HOST, at)).close()
    except OSError as error:
        raise ConfigError(f"--at {at}: {error.strerror}") from None
    set_up(LogFormat.TEXT, LogLevel.ERROR)
    asyncio.run(_run(BenchApi(file, _free_endpoint()), at))


async def _run(api: BenchApi, at: int) -> None:
    stop = stop_event(signal.SIGHUP)  # its terminal has gone
    serving = asyncio.create_task(serve(api, at, partial(print, flush=True)))
    stopping = asyncio.create_task(stop.wait())
    done, _ = await asyncio.wait([serving, stopping], return_when=asyncio.FIRST_COMPLETED)
    for task in (serving, stopping):
        task.cancel()
    await asyncio.gather(serving, stopping, return_exceptions=True)
    for ended in done:
        ended.result()


async def serve(api: BenchApi, at: int, tell: Callable[[str], None]) -> None:
    """Serves the page until it is cancelled, and then ends all that the bench has started.

    `tell` gets the address, and a new one whenever it was used.
    """
    port = asyncio.get_running_loop().create_future()
    entry, connections = Entry(lambda key: tell(_ADDRESS.format(port.result(), key))), Connections()
    config = WebSection().model_copy(update={"listen": (_HOST, at)})
    shared = [one for one in files_of(ASSETS, "page.html") if one.path in _SHARED]
    routes = [
        *api.routes(entry),
        *files_of(_FOLDER, "bench.html"),
        *shared,
        catalogue_route("bench"),
    ]
    listener = Listener(
        config, Guard(config, connections, entry), connections, routes, most_body=MOST_BYTES
    )
    serving = asyncio.create_task(listener.run(port.set_result), name="bench")
    try:
        await asyncio.wait([port, serving], return_when=asyncio.FIRST_COMPLETED)
        if api.draft.file is not None:
            with suppress(ConfigError):  # the page shows the mistakes
                await api.running.look(api.draft.config())
        entry.begin()
        await serving
    finally:
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)
        await api.close()


def _free_endpoint() -> str:
    """Returns the usual endpoint of Zenoh in a new file, or a free one if it is taken."""
    return f"tcp/{_HOST}:{free_port(int(LISTEN.rpartition(':')[2]))}"
