"""The `notify` command: a test of the ways on which alarms reach people."""

import asyncio
import json
import sys
import time
from typing import Annotated

import typer

from gateway.cli.progress import loaded
from gateway.cli.terminal import FAILED, AsJson, ConfigPath, err, out, printable
from gateway.errors import ConfigError


def notify(
    config: ConfigPath,
    ways: Annotated[
        list[str] | None, typer.Argument(metavar="[WAY]...", help="mail, webhook, boss@plant ...")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Send a test message on each way of `notify:`, or on some, from this machine."""
    from gateway.parts.notify.message import message
    from gateway.parts.notify.settings import NotifySection
    from gateway.parts.notify.watch import TEST
    from gateway.parts.notify.ways import ways as ways_of
    from gateway.parts.notify.ways import why_not_sent

    plant = loaded(config)
    if (settings := plant.part(NotifySection)) is None:
        raise ConfigError(f"{config} has no section notify")
    known = ways_of(settings)
    if unknown := [way for way in ways or () if way not in known]:
        raise ConfigError(f"no rule of notify uses {unknown[0]}: there are {', '.join(known)}")
    test = message(plant.zenoh.prefix, plant.name, [TEST], time.time_ns(), settings.language)

    async def send() -> dict[str, str]:
        return {way: await why_not_sent(known[way], test) for way in ways or known}

    tried = asyncio.run(send())
    for way, why in tried.items():
        if as_json:
            print(json.dumps({"way": way, "sent": not why, "why": why}))
        elif why:
            err.print(printable(f"{way}: {why}"))
        else:
            out.print(f"{way}: sent")
    if any(tried.values()):
        sys.exit(FAILED)
