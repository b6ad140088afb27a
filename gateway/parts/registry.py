"""The parts of the service, in the order of their start. A new part is a folder and a line here.

Its modules are found by their names: `part` has `KIND`; `settings`, if there is one, has `SECTION`;
each module of a folder `commands` is a command, and has a function of its name. A name with a dot
is a package elsewhere.
"""

from collections.abc import Mapping, Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from pkgutil import iter_modules
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gateway.config.settings.sections import PartSection
    from gateway.plant.part import Kind

PARTS = (
    *("history", "audit", "state", "serving", "doors", "transfers", "alarms"),
    *("notify", "certificates", "damaged_files", "remote", "web"),
)


def kinds() -> "list[tuple[str, Kind]]":
    """Imports the parts."""
    return [(_short(one), import_module(f"{_package(one)}.part").KIND) for one in PARTS]


def sections() -> "Sequence[PartSection]":
    """Imports the settings of the parts, and nothing else of them."""
    return [
        import_module(f"{_package(one)}.settings").SECTION
        for one in PARTS
        if (_folder(one) / "settings.py").is_file()
    ]


def commands() -> Mapping[str, str]:
    """Returns module and function of each command of a part, without importing any."""
    return {
        found.name: f"{_package(one)}.commands.{found.name}:{found.name}"
        for one in PARTS
        for found in iter_modules([str(_folder(one) / "commands")])
    }


def _short(part: str) -> str:
    return part.rpartition(".")[2]


def _package(part: str) -> str:
    return part if "." in part else f"gateway.parts.{part}"


def _folder(part: str) -> Path:
    if "." not in part:
        return Path(__file__).parent / part
    spec = find_spec(part)
    if spec is None or spec.origin is None:
        raise ImportError(f"there is no package {part}")
    return Path(spec.origin).parent
