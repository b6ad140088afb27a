"""The `backup` command: a copy of the history, also while the gateway runs."""

from pathlib import Path
from typing import Annotated

import typer

from gateway.cli.terminal import ConfigPath
from gateway.config import load
from gateway.errors import GatewayError
from gateway.parts.history.files.backup import backup as copied
from gateway.parts.history.settings import HistorySection


def backup(
    config: ConfigPath,
    copy: Annotated[Path, typer.Argument(metavar="COPY", help="A file that does not exist yet.")],
) -> None:
    """Copy the history to a file. The gateway may run: nothing waits for it."""
    loaded = load(config)
    if (kept := loaded.part(HistorySection)) is None:
        raise GatewayError(f"{config} has no `history:` section")
    size = copied(kept.path, copy)
    print(f"{copy}: {size / 1e6:.1f} MB")
