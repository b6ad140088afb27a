"""Completes names of the file that the command line has already, after Tab in a shell."""

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from gateway.errors import ConfigError

if TYPE_CHECKING:
    from gateway.config import Config


def _of(names: Callable[["Config"], Iterable[str]]) -> Callable[[typer.Context, str], list[str]]:
    def complete(context: typer.Context, begin: str) -> list[str]:
        """A file that does not load completes nothing."""
        from gateway.config import load  # takes as long as most commands

        try:
            found = names(load(context.params.get("config") or _file()))
        except (ConfigError, OSError):
            return []
        return sorted({one for one in found if one.startswith(begin)})

    return complete


def _file() -> Path:
    """Returns the first file of the line: before the value of an option, arguments are unknown."""
    words = (os.environ.get("COMP_WORDS") or os.environ.get("_TYPER_COMPLETE_ARGS", "")).split()
    return Path(next((word for word in words if word.endswith((".yaml", ".yml"))), "plant.yaml"))


def _keys(config: "Config") -> list[str]:
    return [tag.key for device in config.devices for tag in device.tags]


def _alarms(config: "Config") -> list[str]:
    from gateway.parts.alarms.own_faults import FAULTS, GATEWAY
    from gateway.tags import AlarmRule

    devices = config.devices
    of_tags = [tag.key for one in devices for tag in one.tags if tag.feature(AlarmRule)]
    own = [f"{GATEWAY}{code}" for code in FAULTS]
    of_lines = [f"line:{one.name}" for one in config.lines]
    return [*of_tags, *(one.name for one in devices), *of_lines, *own]


tags = _of(lambda config: [device.name for device in config.devices] + _keys(config))
devices = _of(lambda config: [device.name for device in config.devices])
lines = _of(lambda config: [line.name for line in config.lines])
alarms = _of(_alarms)
