"""The doors as a part: other programs ask the devices of a line, between its polls."""

import asyncio
from collections.abc import Mapping, Sequence

from gateway.config import Config
from gateway.contract.documents.state import DoorDocument
from gateway.parts.doors.guest_requests import GuestRequests
from gateway.parts.doors.open_door import OpenDoor
from gateway.parts.doors.settings import Sharing
from gateway.plant.part import Core, Kind, Part, Phase
from gateway.tags import Tag


class SharingPart:
    """All doors of the file."""

    def __init__(self, core: Core, sharing: Sharing) -> None:
        self._core = core
        self._sharing = sharing
        self._doors: Sequence[OpenDoor] = ()

    async def run(self) -> None:
        plant = self._core.plant
        lines = {door.line for door in self._sharing.doors}
        turns = {line: GuestRequests(plant.any_address, self._core.north) for line in lines}
        async with asyncio.TaskGroup() as tasks:
            self._doors = [
                OpenDoor(door, turns[door.line], plant, tasks, self._core.others.audit)
                for door in self._sharing.doors
            ]
            for door in self._doors:
                tasks.create_task(door.run())

    async def take_over(self, config: Config, renewed: Mapping[Tag, Tag]) -> None:
        for door in self._doors:
            door.take_over(config, self._core.plant)

    def documents(self) -> Mapping[str, DoorDocument]:
        now = asyncio.get_running_loop().time()
        return {f"doors/{door.settings.name}": door.document(now) for door in self._doors}


def _make(core: Core) -> Part | None:
    sharing = core.config.part(Sharing)
    return None if sharing is None else SharingPart(core, sharing)


KIND = Kind(_make, Phase.DRIVING)
