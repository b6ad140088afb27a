"""The commands `ca` and `enrol`: the authority of a plant, and a gateway that joins it."""

import asyncio
import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table
from rich.text import Text

from gateway import files
from gateway.cli.certificates.code import Code
from gateway.cli.line.logs import LogFormat, LogLevel, set_up
from gateway.cli.terminal import AsJson, err, out
from gateway.config.settings.parsers import interval
from gateway.contract.access.certificates import expires
from gateway.errors import ConfigError

if TYPE_CHECKING:
    from gateway.cli.certificates.authority import Authority
    from gateway.cli.certificates.signing import Holder
    from gateway.cli.certificates.state import Entry

cli = typer.Typer(help="The plant's own authority for certificates.", no_args_is_help=True)

_NONE = list[str]()
Folder = Annotated[Path, typer.Argument(metavar="FOLDER", help="Of the authority.")]
Name = Annotated[str, typer.Argument(metavar="NAME", help="Of a gateway or a program.")]
Addresses = Annotated[
    list[str], typer.Argument(metavar="[ADDRESS]...", help="Where clients reach the gateway.")
]
At = Annotated[str, typer.Option(metavar="HOST:PORT", help="Where gateways reach it; kept.")]
Client = Annotated[bool, typer.Option("--client", help="A program that only connects.")]


@cli.callback()
def commands() -> None:
    """The plant's own authority for certificates."""


@cli.command()
def create(
    folder: Folder,
    at: At = "",
    days: Annotated[int, typer.Option(min=1, max=36_500, help="How long it is valid.")] = 3650,
) -> None:
    """Make an authority: a key that signs all certificates of the plant."""
    with _package():
        from gateway.cli.certificates.authority import create as made
    out.print(str(made(folder, days, at)))


@cli.command()
def issue(
    folder: Folder,
    name: Name,
    addresses: Addresses = _NONE,
    client: Client = False,
    days: Annotated[int, typer.Option(min=1, max=3650, help="How long it is valid.")] = 825,
    as_json: AsJson = False,
) -> None:
    """Make a key and a certificate here, to be copied by a person."""
    file = _authority(folder).issue(_holder(name, addresses, client=client), days)
    _print_made(file, {"key": str(file.with_suffix(".key"))}, as_json=as_json)


@cli.command()
def serve(
    folder: Folder,
    at: At = "",
    listen: Annotated[
        str, typer.Option(metavar="HOST:PORT", help="Another address of this machine.")
    ] = "",
) -> None:
    """Sign for gateways that were invited, and renew their certificates, until Ctrl-C."""
    authority = _authority(folder)
    from gateway.cli.certificates.serving import serve as served

    set_up(LogFormat.TEXT, LogLevel.INFO)
    asyncio.run(served(authority, at, listen))


@cli.command()
def invite(
    folder: Folder,
    name: Name,
    addresses: Addresses = _NONE,
    client: Client = False,
    days: Annotated[int, typer.Option(min=1, max=3650, help="Of each certificate.")] = 120,
    within: Annotated[str, typer.Option("--for", help="How long the code is good.")] = "1h",
    as_json: AsJson = False,
) -> None:
    """Print a code with which a gateway gets its certificate, once."""
    holder = _holder(name, addresses, client=client)
    seconds = interval(within)
    code = _authority(folder).invite(holder, days, seconds)
    if as_json:
        print(json.dumps({"name": code.name, "at": code.at, "code": str(code), "good": seconds}))
        return
    err.print(f"good once, for {within}; on the gateway: plc-gateway enrol CODE")
    print(code)


@cli.command("list")
def list_(folder: Folder, as_json: AsJson = False) -> None:
    """Print all names with the end of their certificates."""
    state = _authority(folder).state()
    table = Table(box=None, pad_edge=False)
    for column in ("name", "state", "until", "addresses"):
        table.add_column(column)
    for name, entry in sorted(state.names.items()):
        until = max(entry.serials.values(), default=None)
        now = "invited" if name in state.invitations and until is None else _state(entry, until)
        if as_json:
            shown = {"name": name, "state": now, "until": until and _day(until)}
            print(json.dumps({**shown, "addresses": entry.addresses, "client": entry.is_client}))
        table.add_row(name, now, _day(until) if until else "-", Text(" ".join(entry.addresses)))
    if not as_json:
        out.print(table)


@cli.command()
def revoke(folder: Folder, name: Name) -> None:
    """Renew no certificate of a name any more, and list them as revoked."""
    entry = _authority(folder).revoke(name)
    out.print(f"{folder / 'revoked.pem'} has the certificates of {name}")
    until = _day(max(entry.serials.values(), default=time.time()))
    err.print(
        f"Zenoh reads no such list: take {name} out of the access control of the routers, and "
        f"start them again; otherwise it can connect until {until}"
    )


def enrol(
    code: Annotated[
        str | None, typer.Argument(metavar="[CODE]", help="From plc-gateway ca invite.")
    ] = None,
    folder: Annotated[Path, typer.Option(help="Of key and certificate.")] = Path("pki"),
    renew: Annotated[
        bool, typer.Option("--renew", help="In the last third of its life: a new certificate.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Get the certificate of this gateway with a code, or renew it."""
    if (code is None) != renew:
        raise ConfigError("write a code, or --renew")
    with _package():
        from gateway.cli.certificates import enrolment
    if code is None:
        found, is_new = enrolment.renew(folder)
    else:
        found, is_new = enrolment.enrol(folder, Code.parsed(code)), True
    if not is_new and not as_json:
        out.print(f"{found.certificate} need not be renewed")
        return
    others = {"key": str(found.key), "ca": str(found.ca), "new": is_new}
    _print_made(found.certificate, others, as_json=as_json)
    if code is not None and not as_json:
        tls = "".join(f"{name}: {file.resolve()}, " for name, file in found._asdict().items())
        err.print("For the file of the gateway, with the address of its router:")
        print("zenoh:\n  mode: client\n  listen: []\n  connect: [tls/router.plant:7447]")
        print(f"  tls: {{{tls}mutual: true}}")


def _print_made(certificate: Path, others: dict[str, object], *, as_json: bool) -> None:
    until = _day(expires(files.read(certificate)))
    if as_json:
        print(json.dumps({"certificate": str(certificate), **others, "until": until}))
    else:
        out.print(f"{certificate}: valid until {until}")


def _authority(folder: Path) -> "Authority":
    with _package():
        from gateway.cli.certificates.authority import Authority
    return Authority(folder)


def _holder(name: str, addresses: list[str], *, client: bool) -> "Holder":
    if client and addresses:
        raise ConfigError("--client is for a program that no other connects to: no addresses")
    with _package():
        from gateway.cli.certificates.signing import Holder
    return Holder(name, addresses, client)


@contextmanager
def _package() -> Iterator[None]:
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name != "cryptography":
            raise
        raise ConfigError(
            "certificates need the package cryptography: "
            "pip install cryptography, with the pip of the gateway"
        ) from None


def _state(entry: "Entry", until: float | None) -> str:
    if entry.is_revoked:
        return "revoked"
    if until is None:
        return "never enrolled"
    return "valid" if until > time.time() else "ended"


def _day(at: float) -> str:
    return f"{datetime.fromtimestamp(at, UTC):%Y-%m-%d}"
