"""The `doctor` command: what of this computer keeps the file from running, and what mends it.

It sends nothing to a PLC. While the gateway runs, its ports are left alone: a device server with
one connection would close the gateway's.
"""

import ctypes
import getpass
import json
import os
import shutil
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from rich.table import Table
from rich.text import Text

from gateway import __version__
from gateway.cli.client import connected
from gateway.cli.progress import loaded
from gateway.cli.terminal import FAILED, AsJson, ConfigPath, out, printable
from gateway.config import Config, LineConfig
from gateway.config.loading import written
from gateway.config.messages import dotted
from gateway.contract.faults import faults
from gateway.errors import GatewayError, LineDown
from gateway.northbound.northbound import check as zenoh_warnings
from gateway.parts.history.settings import HistorySection
from gateway.parts.history.store.place import trouble
from gateway.transport.os_errors import line_down
from gateway.transport.port import (
    ListenAddress,
    ModemAddress,
    PortAddress,
    Rfc2217Address,
    SerialPath,
    TcpAddress,
    UdpAddress,
    named,
)

_WITHIN = 3.0  # seconds for a connection
_REFUSES_WITHIN = 0.5  # seconds
_SLOW_LATENCY = 1  # ms of an FTDI adapter; 16 by default
_UNSYNCHRONISED = 5  # result of `adjtimex`, Linux
_OTHER_PORT = "another `port` in the file"
_STYLES = {"good": "green", "look": "yellow", "bad": "red"}


class Finding(NamedTuple):
    """One line: what was looked at, how it is, and the command or the setting that mends it."""

    what: str
    says: str
    mend: str = ""
    state: str = "good"  # `look`: it may be wanted; `bad`: it does not work


def doctor(config: ConfigPath, as_json: AsJson = False) -> None:
    """Look at ports, rights, disk, clock, certificates and the running gateway of a file."""
    found = list(findings(loaded(config), config))
    if as_json:
        for one in found:
            print(json.dumps(one._asdict()))
    else:
        out.print(_table(found))
    if any(one.state == "bad" for one in found):
        sys.exit(FAILED)


def findings(config: Config, file: Path) -> Iterator[Finding]:
    """Yields a finding for everything that was looked at."""
    yield Finding(str(file), "has no mistake")
    gateway, runs = _gateway(config, file)
    yield from gateway
    for line in config.lines:
        for one in _port(line.port, line, runs=runs):
            yield one._replace(what=f"line {line.name}, {one.what}")
    yield from _files(config)
    yield from _certificates(config)
    yield from _clock()


def _gateway(config: Config, file: Path) -> tuple[list[Finding], bool]:
    """Returns the findings about the running gateway, and whether it runs."""
    what = f"gateway {config.name}"
    try:
        with connected(config, lambda _: None) as client:
            documents = client.documents()
    except GatewayError as error:
        start = f"plc-gateway run {file}"
        return [Finding(what, str(error), start, "look")], False
    found, version = [], documents["status"]["version"]
    if version != __version__:
        says = f"runs version {version}, this command is {__version__}"
        found.append(Finding(what, says, "start the gateway again", "look"))
    wrong = list(faults(documents))
    if wrong:
        says, state = f"runs, and {len(wrong)} things are wrong: {wrong[0]}", "bad"
        found.append(Finding(what, says, f"plc-gateway status {file}", state))
    return found or [Finding(what, f"runs, version {version}")], True


def _port(port: PortAddress, line: LineConfig, *, runs: bool) -> Iterator[Finding]:
    match port:
        case ModemAddress(below):
            yield from _port(below, line, runs=runs)
        case SerialPath(path):
            yield from _serial(path, runs=runs)
        case UdpAddress(host, number):
            says = "not tried: a port udp:// shows by its first reply that a device is there"
            yield Finding(named(host, number), says)
        case TcpAddress(host, number) | Rfc2217Address(host, number) if not line.serve:
            yield _tried(port, runs, lambda: _connected(port), f"ping {host}")
        case TcpAddress(host, number) | ListenAddress(host, number):
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            served = socket.create_server
            yield _tried(port, runs, lambda: served((host, number), family=family), _OTHER_PORT)


def _connected(port: TcpAddress | Rfc2217Address) -> socket.socket:
    """Raises `OSError`, `LineDown`."""
    found = socket.create_connection((port.host, port.port), _WITHIN)
    if isinstance(port, TcpAddress) and (tls := port.tls) is not None:
        from gateway.transport.tls import make_context  # it takes 10 ms

        with found:
            context = make_context(tls, serves=False)
            found = context.wrap_socket(found, server_hostname=tls.name or port.host)
            with suppress(TimeoutError):  # a refusal of TLS 1.3 comes after the handshake
                found.settimeout(_REFUSES_WITHIN)
                found.recv(1)
    return found


def _tried(
    port: TcpAddress | Rfc2217Address | ListenAddress,
    runs: bool,
    attempt: Callable[[], socket.socket],
    mend: str,
) -> Finding:
    what = named(port.host, port.port)
    if runs:
        return Finding(what, "not tried: the gateway uses it")
    try:
        attempt().close()
    except (OSError, OverflowError, LineDown) as error:
        return Finding(what, str(line_down(what, error)).partition(": ")[2], mend, "bad")
    return Finding(what, "free to listen at" if mend == _OTHER_PORT else "can be connected to")


def _serial(path: str, *, runs: bool) -> Iterator[Finding]:
    port = Path(path)
    if not port.exists():
        there = ", ".join(sorted(map(str, Path("/dev/serial/by-id").glob("*"))))
        mend = f"one of {there}" if there else "plug in the adapter: `dmesg -w` shows its name"
        yield Finding(path, "no such port", mend, "bad")
        return
    if not port.is_char_device():
        yield Finding(path, "not a serial port", _OTHER_PORT, "bad")
        return
    if not os.access(port, os.R_OK | os.W_OK):
        mend = f"sudo usermod -aG {_group(port)} {getpass.getuser()}, then log in again"
        yield Finding(path, "this user may not use it", mend, "bad")
    elif not runs and (users := list(_users(port))):
        says = f"process {', '.join(users)} has it open"
        yield Finding(path, says, "end that program, or use another port", "bad")
    else:
        yield Finding(path, "may be used")
    if sys.platform == "linux":
        yield from _adapter(port)


def _group(port: Path) -> str:
    with suppress(KeyError, OSError):  # a group without a name
        return port.group()
    return "dialout"


def _users(port: Path) -> Iterator[str]:
    """Yields the processes that have it open, as far as this user may see them."""
    real = os.path.realpath(port)
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has ended, or it is another user's
            if any(os.path.realpath(one) == real for one in (process / "fd").iterdir()):
                yield f"{process.name} ({(process / 'comm').read_text().strip()})"


def _adapter(port: Path) -> Iterator[Finding]:
    """Yields what is known of a USB adapter."""
    real = Path(os.path.realpath(port))
    if real == port and port.name.startswith(("ttyUSB", "ttyACM")):
        links = [one for one in Path("/dev/serial/by-id").glob("*") if one.samefile(port)]
        links += [one for one in Path("/dev/serial/by-path").glob("*") if one.samefile(port)]
        mend = f"port: {links[0]}" if links else "docs/deployment.md: names of serial ports"
        yield Finding(str(port), "another adapter may have this name tomorrow", mend, "look")
    timer = Path(f"/sys/class/tty/{real.name}/device/latency_timer")
    with suppress(OSError, ValueError):  # no FTDI adapter
        latency = int(timer.read_text())
        if latency > _SLOW_LATENCY:
            mend = f"echo {_SLOW_LATENCY} | sudo tee {timer}; for ever: docs/deployment.md"
            yield Finding(str(port), f"the adapter delays replies by {latency} ms", mend, "look")


def _files(config: Config) -> Iterator[Finding]:
    for setting, file, _, _ in written(config):
        why = trouble(file)
        mend = "" if why is None else "run this as the user of the service"
        says, state = ("can be written", "good") if why is None else (why, "bad")
        yield Finding(f"{dotted(setting)}, {file}", says, mend, state)
    history = config.part(HistorySection)
    if history is not None and history.path.parent.is_dir():
        used = history.path.stat().st_size if history.path.exists() else 0
        free, left = shutil.disk_usage(history.path.parent).free, history.max_size - used
        says = f"{free / 1e9:.1f} GB are free, history may grow by {max(0, left) / 1e9:.1f} GB"
        short = free < left
        mend = f"history: {{max_size: {max(1, int((free + used) / 2e6))}MB}}" if short else ""
        yield Finding(f"disk of {history.path}", says, mend, "bad" if short else "good")


def _certificates(config: Config) -> Iterator[Finding]:
    for sentence in zenoh_warnings(config):
        yield Finding("zenoh", sentence, "docs/security.md", "look")


def _clock() -> Iterator[Finding]:
    if sys.platform != "linux":
        return
    with suppress(OSError, AttributeError):  # a system without it
        state = ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(1024))
        if state == _UNSYNCHRONISED:
            mend = "sudo timedatectl set-ntp true"
            yield Finding("clock", "is not synchronised: times may be wrong", mend, "look")
        elif state >= 0:
            yield Finding("clock", "is synchronised")


def _table(found: list[Finding]) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for column in ("", "what", "how it is", "what mends it"):
        table.add_column(column)
    for one in found:
        texts = [Text(printable(text)) for text in (one.what, one.says, one.mend)]
        table.add_row(Text(one.state, style=_STYLES[one.state]), *texts)
    return table
