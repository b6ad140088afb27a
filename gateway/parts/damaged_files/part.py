"""Watches for damaged files that were moved aside: what they held is lost, and a person must know.

It looks at the folder, not at what this process did: the fault survives a restart.
"""

import asyncio
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from typing_extensions import TypedDict

from gateway.config import Config
from gateway.config.loading import written
from gateway.contract.documents.catalogue import in_status
from gateway.contract.line_faults import Fault
from gateway.plant.part import Core, Kind, Phase
from gateway.plant.saved_file import ASIDE
from gateway.plant.threads import off_loop

LOOK_EVERY = 2.0  # seconds


class DamagedDocument(TypedDict):
    """Damaged files that were moved aside."""

    files: list[str]


class DamagedFilesPart:
    """The files of `SavedFile` that lie beside the present ones."""

    def __init__(self, core: Core) -> None:
        self._core = core
        self._found: Sequence[str] = ()

    async def run(self) -> None:
        while True:
            with suppress(OSError):  # a disk that does not answer: what was known stays
                self._found = await off_loop(moved_aside, self._core.config)
            await asyncio.sleep(LOOK_EVERY)

    def documents(self) -> Mapping[str, Mapping[str, object]]:
        return {"damaged": {"files": self._found}}

    def faults(self) -> Sequence[Fault]:
        told = "is a damaged file that was moved aside, and what it held is forgotten"
        return [
            Fault("damaged-file", f"{file} {told}: remove or rename it when you know")
            for file in self._found
        ]


def moved_aside(config: Config) -> list[str]:
    """Returns the paths of the files that were moved aside. Blocks."""
    files = [Path(f"{one.file}{ASIDE}") for one in written(config) if ASIDE in one.tails]
    return [str(file) for file in files if file.is_file()]


KIND = Kind(DamagedFilesPart, Phase.SHOWING, documents=(in_status("damaged", DamagedDocument),))
