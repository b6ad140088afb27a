"""The doors as a part: other programs ask the devices of a line, between its polls."""

import asyncio
import time
from collections.abc import Callable, Iterator, Mapping, Sequence

from gateway.config import Config
from gateway.contract import payload
from gateway.contract.documents.catalogue import SEND, DocumentKind, in_status, own
from gateway.contract.interfaces import Keyed
from gateway.errors import BadValue, NoHistory, Unknown
from gateway.parts.doors.documents import DoorDocument, DoorRequest
from gateway.parts.doors.guest_requests import GuestRequests
from gateway.parts.doors.open_door import OpenDoor
from gateway.parts.doors.settings import Sharing
from gateway.plant.part import Core, Kind, Part, Phase
from gateway.tags import Tag

_RELEASE = b'{"do":"release"}'


class SharingPart:
    """All doors of the file."""

    def __init__(self, core: Core, sharing: Sharing) -> None:
        self._core = core
        self._sharing = sharing
        self._doors: Sequence[OpenDoor] = ()
        self._now: Callable[[], float] = time.monotonic

    async def run(self) -> None:
        plant = self._core.plant
        self._now = asyncio.get_running_loop().time
        most = dict[str, float]()
        for one in self._sharing.doors:
            most[one.line] = max(most.get(one.line, 0.0), one.most)
        turns = {
            line: GuestRequests(plant.any_address, self._core.north, share)
            for line, share in most.items()
        }
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
        now = self._now()
        return {f"doors/{door.settings.name}": door.document(now) for door in self._doors}

    # -- its keys --

    def entries(self) -> Sequence[tuple[str, Callable[[], bytes]]]:
        return [(door.settings.name, self._maker(door)) for door in self._doors]

    def _maker(self, door: OpenDoor) -> Callable[[], bytes]:
        return lambda: payload.document(door.document(self._now()))

    def recorded(self, time_range: str, now: int) -> Iterator[tuple[str, str]]:
        raise NoHistory

    async def order(self, path: str, data: bytes, by: str | None) -> bytes:
        """Releases a door. Raises `BadValue`, `Unknown`."""
        door = next((one for one in self._doors if one.settings.name == path), None)
        if door is None:
            raise Unknown(f"there is no door {payload.short(path)}")
        if data.replace(b" ", b"") != _RELEASE:
            raise BadValue(f"send {_RELEASE.decode()}")
        door.release(by or "a client")
        return self._maker(door)()


def _make(core: Core) -> Part | None:
    sharing = core.config.part(Sharing)
    return None if sharing is None else SharingPart(core, sharing)


DOCUMENTS = (
    in_status("doors/{door}", DoorDocument),
    DocumentKind("release", own("doors/{door}"), (SEND,), DoorDocument, DoorRequest),
)
KIND = Kind(_make, Phase.DRIVING, serves=Keyed, documents=DOCUMENTS)
