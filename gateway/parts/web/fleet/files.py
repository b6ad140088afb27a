"""The files that the gateways of the fleet should run, read by a process of its own.

A thousand files take seconds of a processor, and may have mistakes of any kind. That process is
less important than the gateway, has a bound of memory and time, and runs only after a change.
"""

import asyncio
import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from gateway.contract.fleet_files import Wanted, state_of
from gateway.errors import GatewayError, words_of
from gateway.plant.threads import off_loop

PATIENCE = 5.0  # seconds that an answer waits for the files
READ_WITHIN = 300.0  # seconds
READ_AGAIN = 600.0  # seconds: a sheet may be outside of the folder
_MOST_TOLD = 100  # mistakes

Found = tuple[Mapping[str, Wanted] | None, Sequence[str]]


class FleetFiles:
    """The gateways of a folder that are under the prefix, as `found`: None in place of them until
    the files are read for the first time; and the mistakes."""

    def __init__(self, folder: Path, prefix: str) -> None:
        self._folder, self._prefix = folder, prefix
        self._reading: asyncio.Task[None] | None = None
        self._state: int | None = None
        self._read_at = float("-inf")
        self.found: Found = None, ()

    async def look(self) -> None:
        """Reads the files if they changed. Returns when it is done, or after `PATIENCE`: the next
        call goes on waiting."""
        if self._reading is None or self._reading.done():
            self._reading = asyncio.create_task(self._look(), name="files of the fleet")
        done, _ = await asyncio.wait([self._reading], timeout=PATIENCE)
        if not done:
            wanted, mistakes = self.found
            about = f"the files in {self._folder} are being read"
            self.found = wanted, [about, *(one for one in mistakes if one != about)]

    async def _look(self) -> None:
        now = asyncio.get_running_loop().time()
        try:
            state = await off_loop(state_of, self._folder, within=READ_WITHIN)
            if state == self._state and now - self._read_at < READ_AGAIN:
                return
            self.found = await off_loop(self._read, within=READ_WITHIN)
            self._state, self._read_at = state, now
        except GatewayError as error:
            self._state = None
            self.found = self.found[0], [f"{self._folder}: {error}"]

    def _read(self) -> Found:
        """Raises `GatewayError`. Blocks."""
        # `-P`: modules of this program only, not those of the working directory.
        command = [sys.executable, "-P", "-m", "gateway.contract.fleet_files", str(self._folder)]
        try:
            done = subprocess.run(  # noqa: S603  (this program, with the folder of the file)
                command, capture_output=True, timeout=READ_WITHIN, check=True
            )
            wanted, mistakes = json.loads(done.stdout)
        except subprocess.CalledProcessError as error:
            last = error.stderr.decode("utf-8", "replace").splitlines()[-1:]
            raise GatewayError(f"its files were not read: {' '.join(last)}") from None
        except (subprocess.SubprocessError, OSError, ValueError) as error:
            raise GatewayError(f"its files were not read: {words_of(error)}") from None
        found = {
            gateway: Wanted(Path(file), digest)
            for gateway, (file, digest) in wanted.items()
            if gateway.startswith(f"{self._prefix}/")
        }
        return found, mistakes[:_MOST_TOLD]
