"""The parts of the service, in the order of their start. A new part is a folder and a line here."""

from importlib import import_module

from gateway.plant.part import Kind

PARTS = ("history", "audit", "state", "serving", "transfers", "alarms", "certificates", "web")


def kinds() -> list[tuple[str, Kind]]:
    """Imports the parts: each says what it is in `KIND` of its module `part`."""
    return [(name, import_module(f"gateway.parts.{name}.part").KIND) for name in PARTS]
