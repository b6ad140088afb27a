"""Terminal output, exit codes and the arguments that several commands share."""

import sys
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from rich.console import Console

from gateway.cli import completion

USER_MISTAKE, FAILED = 2, 1
# Values of tags may hold brackets and colons: no markup.
out = Console(
    highlight=False, markup=False, emoji=False, width=None if sys.stdout.isatty() else 200
)
err = Console(stderr=True, highlight=False, markup=False, emoji=False, soft_wrap=True)

ConfigPath = Annotated[Path, typer.Argument(metavar="CONFIG", help="The YAML file.")]
TagNames = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[TAG]...",
        help="device/tag; wildcards as in Zenoh: 'mixer/**'",
        autocompletion=completion.tags,
    ),
]
Direct = Annotated[
    bool,
    typer.Option("--direct", help="Open the port without a gateway; none may be running on it."),
]
# One endpoint of Zenoh, where a command does not read it from the file of a gateway.
ROUTER = "tcp/127.0.0.1:7447"
ZenohFile = Annotated[
    Path | None, typer.Option("--zenoh", metavar="FILE", help="A Zenoh file with user and TLS.")
]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON document per line.")]

Utc = Annotated[bool, typer.Option("--utc", help="Times in UTC instead of this machine's zone.")]


def printable(text: str, keep: str = "") -> str:
    """Escapes characters that move the cursor, forge a line or control the terminal otherwise.

    Values and reasons come from devices and from other programs on the network.
    """
    if text.isprintable():
        return text
    escaped = (c if c.isprintable() or c in keep else repr(c)[1:-1] for c in text)
    return "".join(escaped)


def end(message: str, code: int) -> NoReturn:
    """Prints the message to stderr and exits with the code."""
    err.print(message)
    sys.exit(code)
