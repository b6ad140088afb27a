"""The devices of docs/no-protocol.md, as the gateway reads them from its file."""

from functools import cache
from pathlib import Path
from typing import Any

import yaml
from pydantic import TypeAdapter

from gateway.protocols.frames import Frames

PAGE = Path(__file__).parents[2] / "docs" / "no-protocol.md"
_DURATIONS = ("gap", "stale_after")


@cache
def documented() -> dict[str, dict[str, Any]]:
    """Every device of the page by name: its settings, tags included."""
    blocks = PAGE.read_text(encoding="utf-8").split("```yaml\n")[1:]
    devices: dict[str, dict[str, Any]] = {}
    for block in blocks:
        devices |= yaml.safe_load(block.split("```")[0])
    return devices


def device(name: str) -> Frames:
    """One device of the page; its tags must name fields that it has."""
    settings = dict(documented()[name])
    tags = settings.pop("tags")
    made = load(settings)
    for tag in tags.values():
        made.field_of(tag["address"])
    return made


def load(settings: dict[str, Any]) -> Frames:
    """As the configuration does it: pydantic fills the dataclasses. Raises `ValidationError`."""
    return TypeAdapter(Frames).validate_python(_seconds(settings))


def _seconds(settings: Any) -> Any:
    if not isinstance(settings, dict):
        return settings
    return {
        name: _duration(value) if name in _DURATIONS else _seconds(value)
        for name, value in settings.items()
    }


def _duration(text: str) -> float:
    return float(text[:-2]) / 1000 if text.endswith("ms") else float(text[:-1])
