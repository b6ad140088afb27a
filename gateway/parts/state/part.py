"""The state file as a part: read before the lines are planned, then saved regularly."""

import asyncio

import structlog

from gateway.errors import GatewayError
from gateway.parts.state.state_file import StateFile
from gateway.plant.part import Core, Kind, Part
from gateway.plant.threads import off_loop

log = structlog.get_logger("gateway")
SAVE_EVERY = 10.0  # seconds
CLOSE_WITHIN = 0.5  # seconds; a lost state file costs only a new search


class StatePart:
    """Knowledge of the devices, and the totals of counters."""

    def __init__(self, core: Core, file: StateFile) -> None:
        self._plant = core.plant
        self._file = file

    async def restore(self) -> None:
        content = await off_loop(self._file.load)
        self._file.restore(self._plant.enabled_devices, content)
        self._plant.mirror.restore(self._file.counters)
        self._plant.doors.is_restored = True

    async def run(self) -> None:
        """Raises `GatewayError` where the file was never read: nothing may take its place."""
        if not self._plant.doors.is_restored:
            raise GatewayError("the state file was not read at the start: it is left as it was")
        self._file.start()
        try:
            while True:
                await asyncio.sleep(SAVE_EVERY)
                self._file.save_soon(self._snapshot())
        finally:
            self._file.save_last(self._snapshot())
            if not await off_loop(self._file.close, CLOSE_WITHIN):
                log.warning("state file close timed out", effect="the last changes are not saved")

    def _snapshot(self) -> bytes:
        counters = self._plant.mirror.counters()
        return self._file.snapshot(self._plant.enabled_devices, counters)


def _make(core: Core) -> Part | None:
    path = core.config.state_file
    return None if path is None else StatePart(core, StateFile(path))


KIND = Kind(_make)
