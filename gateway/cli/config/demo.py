"""The `demo` command: a gateway of simulated PLCs with its page, without a file of the user."""

import os
import shutil
import socket
import sys
import tempfile
import webbrowser
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from gateway.cli.line.logs import LogFormat, LogLevel, set_up
from gateway.cli.run import end_beside_zenoh, serve
from gateway.config import load
from gateway.errors import GatewayError
from gateway.parts.web.settings import WebSection

_PLANT = Path(__file__).with_name("demo.yaml")
_HOST = "127.0.0.1"
_PORTS = (7447, 8080)  # of Zenoh and of the page, in the file


def demo(
    browser: Annotated[
        bool, typer.Option(help="open the page where there is a desktop (default: yes)")
    ] = True,
) -> None:
    """Run a gateway of simulated PLCs with its page, to try it without hardware.

    Its file and history are in a new folder, which is removed at the end.
    """
    text = _PLANT.read_text(encoding="utf-8")
    for usual in _PORTS:
        text = text.replace(f"{_HOST}:{usual}", f"{_HOST}:{free_port(usual)}")
    say = set_up(LogFormat.TEXT, LogLevel.ERROR)
    try:
        folder = Path(tempfile.mkdtemp(prefix="plc-gateway-demo-"))
    except OSError as error:
        raise GatewayError(f"no folder was made for the demo: {error.strerror}") from None
    try:
        path = folder / "plant.yaml"
        path.write_text(text, encoding="utf-8")
        config = load(path)
        page = config.part(WebSection)

        def started(hint: str) -> None:
            say(hint)
            if browser and page is not None and _has_desktop():
                webbrowser.open(page.url)

        serve(config, path, started)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    end_beside_zenoh()


def free_port(usual: int) -> int:
    """Returns the usual TCP port of this machine, or a free one if it is taken."""
    for port in (usual, 0):
        with socket.socket() as probe, suppress(OSError):
            probe.bind((_HOST, port))
            return int(probe.getsockname()[1])
    return usual


def _has_desktop() -> bool:
    """Without a desktop `webbrowser` would open a browser of text in this terminal."""
    known = ("DISPLAY", "WAYLAND_DISPLAY")
    return sys.stdout.isatty() and (sys.platform == "darwin" or any(map(os.environ.get, known)))
