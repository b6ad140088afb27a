"""The served lines as a part."""

import asyncio
from collections.abc import Mapping

from gateway.line.wire_log import WireLog
from gateway.parts.serving.served_lines import ServedLines
from gateway.parts.serving.status import served_documents
from gateway.plant.part import Core, Kind, Part, Phase
from gateway.plant.plant import Plant
from gateway.tags import Sample


class ServingPart:
    """The lines on which the gateway is a station of another master."""

    def __init__(self, plant: Plant) -> None:
        def sample_of(key: str) -> Sample | None:
            tag = plant.tag(key)
            return None if tag is None else plant.sample(tag)

        self._served = served = ServedLines(
            plant.config, plant, sample_of, wall=plant.wall, duty=plant.duty
        )
        self.holds, self.write_group = served.holds, served.write_group
        self.seen = served.remember
        self.lines = served.lines

    @property
    def wants(self) -> bool:
        return bool(self._served.remembering)

    async def begin(self) -> None:
        await self._served.restore()

    async def run(self) -> None:
        async with asyncio.TaskGroup() as tasks:
            for line in self.lines:
                tasks.create_task(line.run(), name=line.name)

    def wire_logs(self) -> Mapping[str, WireLog]:
        return {line.name: line.wire_log for line in self.lines}

    def documents(self) -> Mapping[str, Mapping[str, object]]:
        return served_documents(self.lines, asyncio.get_running_loop().time())


def _make(core: Core) -> Part | None:
    return ServingPart(core.plant) if any(line.serve for line in core.config.lines) else None


KIND = Kind(_make, Phase.DRIVING)
