"""The `audit` command: who wrote, commanded and acknowledged what; checks the chain."""

import json
import sys
import time
from typing import Annotated

import typer

from gateway.cli.progress import loaded
from gateway.cli.terminal import ConfigPath
from gateway.contract.past.timerange import LATEST, time_range
from gateway.errors import GatewayError
from gateway.parts.audit.file import checked, read
from gateway.tags.timestamps import rfc3339


def audit(
    config: ConfigPath,
    period: Annotated[str, typer.Option("--time", help="A range as in a query of Zenoh")] = "[..]",
) -> None:
    """Print the audit as lines of JSON, and check that no record was changed or taken out."""
    path = loaded(config).audit_file
    if path is None:
        raise GatewayError(f"{config} has no `audit:` below `gateway:`")
    asked = time_range(period, time.time_ns())
    first, last = rfc3339(max(asked.first, 0)), rfc3339(min(asked.last, LATEST))
    broken, count = list[str](), 0
    try:
        for record in checked(read(path)):
            count += 1
            if record.why:
                broken.append(record.why)
            elif first <= record.time <= last:
                shown = {"n": record.number, "time": record.time, **_fields(record.event)}
                sys.stdout.write(json.dumps(shown) + "\n")
    except BrokenPipeError:  # `| head`
        raise
    except OSError as error:
        raise GatewayError(f"{path} cannot be read: {error.strerror}") from None
    if broken:
        raise GatewayError(f"{path} was changed: {broken[0]}, and {len(broken) - 1} more")
    if not count:
        raise GatewayError(f"{path} has no records")


def _fields(event: object) -> dict[str, object]:
    if not isinstance(event, dict):
        return {"event": event}
    return {name: value for name, value in event.items() if name != "time"}
