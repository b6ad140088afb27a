"""The parts of the gateway that the HTTP side uses. It changes none of them but by a write."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from gateway.contract.interfaces import Device, History, Lines
from gateway.contract.payload import Failure, GroupResult
from gateway.parts.alarms import Alarms
from gateway.tags import Sample, Tag, WriteResult

Documents = Mapping[str, Mapping[str, Any]]  # by path: `status`, `lines/hall-1`, `devices/mixer`


class Plant(Lines, Protocol):
    """The devices and their samples."""

    @property
    def alarms(self) -> Alarms: ...

    def devices(self) -> Iterable[Device]: ...

    def tag(self, key: str) -> Tag | None:
        """Finds a tag by `device/name`."""

    def sample(self, tag: Tag) -> Sample:
        """Returns the current sample; any thread may call it."""


class North(Protocol):
    """The status documents, and the one path of writes."""

    async def documents(self, max_age: float) -> Documents:
        """Returns the status documents by path, at most `max_age` seconds old."""

    async def write(
        self, tag: str, data: bytes, by: str, arrived: float
    ) -> WriteResult | Failure | GroupResult:
        """Writes for the client `by`. `arrived`: by the loop's clock."""

    def acknowledge(self, alarm: str, data: bytes, by: str, arrived: float) -> bytes | Failure:
        """Acknowledges for the client `by`. Returns the document of the alarm."""


@dataclass(frozen=True, slots=True)
class Sources:
    """Everything that the HTTP side shows. `ready`: the gateway serves its plant on Zenoh."""

    plant: Plant
    north: North
    history: History | None
    ready: Callable[[], bool]
