"""The history as a part: it records published samples, and answers queries of the past."""

import asyncio
from collections.abc import Mapping, Sequence

import structlog

from gateway.contract.documents.catalogue import in_status
from gateway.contract.interfaces import History
from gateway.parts.history.historian import Historian, HistoryDocument
from gateway.parts.history.settings import HistorySection
from gateway.plant.part import Core, Kind, Part, Phase, Remembers
from gateway.plant.plant import Plant
from gateway.plant.threads import off_loop
from gateway.tags import Sample

log = structlog.get_logger("gateway")
CLOSE_WITHIN = 0.7  # seconds for the last samples


class HistoryPart:
    """Records samples before the event loop takes the query of a client that received them."""

    def __init__(self, plant: Plant, historian: Historian) -> None:
        self._plant = plant
        self._historian = historian

    @property
    def history(self) -> History:
        return self._historian

    def publish(self, samples: Sequence[Sample]) -> None:
        self._historian.record(samples)

    def set_online(self, device: str, online: bool) -> None:
        """History keeps no device states."""

    def activate(self) -> None:
        self._historian.record(self._plant.mirror.samples())  # "starting" marks the restart

    def documents(self) -> Mapping[str, Mapping[str, object]]:
        return {"history": self._historian.document()}

    async def run(self) -> None:
        self._historian.start()
        try:
            await asyncio.Event().wait()
        finally:
            if not await off_loop(self._historian.close, CLOSE_WITHIN):
                log.error("history close timed out", effect="samples that are not on disk are lost")


def _make(core: Core) -> Part | None:
    kept = core.config.part(HistorySection)
    if kept is None:
        return None
    return HistoryPart(core.plant, Historian(kept.path, kept.keep, kept.max_size))


KIND = Kind(
    _make, Phase.KEEPING, serves=Remembers, documents=(in_status("history", HistoryDocument),)
)
