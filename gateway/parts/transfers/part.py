"""The transfers as a part: it writes by the same path as clients do."""

import asyncio
from collections.abc import Mapping, Sequence

from gateway.config import Config
from gateway.contract.documents.catalogue import in_status
from gateway.engine.forecast import LineForecast
from gateway.parts.transfers.documents import TransferDocument
from gateway.parts.transfers.forecast import transfer_forecasts, with_transfers
from gateway.parts.transfers.runner import Transfers
from gateway.plant.part import Core, Kind, Phase
from gateway.tags import Tag


class TransferPart:
    """The rows of the file."""

    def __init__(self, core: Core) -> None:
        self._rows = rows = Transfers(core.plant, core.north.write_own, core.config.transfers)
        core.plant.adjust_forecasts(with_writes)
        self.publish, self.set_online = rows.publish, rows.set_online
        self.documents = rows.documents

    async def begin(self) -> None:
        self._rows.start()

    async def run(self) -> None:
        try:
            await asyncio.Event().wait()
        finally:
            await self._rows.stop()

    async def take_over(self, config: Config, renewed: Mapping[Tag, Tag]) -> None:
        self._rows.renew(config.transfers, renewed)


def with_writes(config: Config, polls: Sequence[LineForecast]) -> Sequence[LineForecast]:
    """Returns the forecasts with the writes of the rows."""
    lines = [*polls]
    return with_transfers(lines, transfer_forecasts(config, lines))


KIND = Kind(
    TransferPart, Phase.DRIVING, documents=(in_status("transfers/{number}", TransferDocument),)
)
