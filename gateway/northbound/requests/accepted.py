"""Keeps on disk until when signatures were accepted, so that a restart accepts none again.

The time on disk is always later than that of any accepted signature, by some seconds. So most
writes do not wait for the disk.
"""

import asyncio
from pathlib import Path

import orjson

from gateway.contract.access.writers import EARLIEST, LATEST
from gateway.plant.saved_file import SavedFile
from gateway.plant.threads import off_loop

AHEAD = LATEST + EARLIEST  # seconds
# Seconds that a write waits for the disk. A disk that hangs or is full keeps no operator from
# writing.
_PATIENCE = 0.5


class AcceptedUntil:
    """The file. Belongs to the event loop."""

    def __init__(self, path: Path) -> None:
        self._file = SavedFile(path)
        # The time until which an earlier process may have accepted, in seconds since 1970.
        self.floor = self._file.load(_parse) or 0.0
        self._kept = self.floor
        self._saving: asyncio.Task[None] | None = None

    async def keep(self, newest: float) -> None:
        """Returns when a restart refuses a signature of this time, or the disk took too long."""
        if newest <= self._kept:
            return
        if self._saving is None or self._saving.done():
            self._saving = asyncio.create_task(self._save(newest + AHEAD))
        await asyncio.wait([self._saving], timeout=_PATIENCE)

    async def _save(self, until: float) -> None:
        await off_loop(self._file.save, orjson.dumps({"accepted_until": until}))
        if self._file.trouble is None:
            self._kept = until


def _parse(found: object) -> float:
    """Raises `ValueError`."""
    match found:
        case {"accepted_until": int() | float() as until} if 0 <= until < 2**36:
            return float(until)
    raise ValueError("no time of accepted signatures")
