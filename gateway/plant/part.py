"""The contract of a part: a feature beside the lines, which can fail without them.

A part is one folder of `gateway/parts/` and one line of `gateway/parts/registry.py`. It must have
`run`. Everything else is a capability: one Protocol below for each, and a part has those it needs.
A bulkhead (`gateway/service/bulkheads.py`) calls all of them. An error there ends the part, never a
line: it is logged and shown, and the part is made again after a pause.

Every method is called on the event loop unless its docstring says otherwise. None may block: files,
names and subprocesses belong on a thread (`gateway/plant/threads.py`). What a part keeps of clients
or samples has a bound, which its module says.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from gateway.config import Config
from gateway.contract.documents.catalogue import DocumentKind
from gateway.contract.interfaces import History, North
from gateway.contract.line_faults import Fault
from gateway.line.wire_log import WireLog
from gateway.plant.plant import Plant
from gateway.tags import Sample, Tag, WriteResult
from gateway.values import Value


class Part(Protocol):
    """One feature while it works. After a failure another one is made."""

    async def run(self) -> None:
        """Runs until cancelled, and then closes what it has opened."""


# -- capabilities: the life ----------------------------------------------------------------------


@runtime_checkable
class Restores(Protocol):
    """Reads a file before the lines are planned."""

    async def restore(self) -> None: ...


@runtime_checkable
class Begins(Protocol):
    """Has work to do before the lines begin. The lines wait for it, but not for long."""

    async def begin(self) -> None: ...


@runtime_checkable
class TakesOver(Protocol):
    """Takes over a changed file."""

    async def take_over(self, config: Config, renewed: Mapping[Tag, Tag]) -> None:
        """`renewed`: old tags whose values go on, with their successors."""


@runtime_checkable
class Activates(Protocol):
    """Notes that this gateway is active now: its lines begin."""

    def activate(self) -> None: ...


# -- capabilities: samples -----------------------------------------------------------------------


@runtime_checkable
class Sees(Protocol):
    """Sees each sample that the mirror has stored."""

    @property
    def wants(self) -> bool:
        """False: no tag of the present file concerns it, and `seen` is not called."""

    def seen(self, samples: Sequence[Sample]) -> None: ...


@runtime_checkable
class Follows(Protocol):
    """Follows the samples that are published, and the devices."""

    def publish(self, samples: Sequence[Sample]) -> None: ...

    def set_online(self, device: str, online: bool) -> None: ...


@runtime_checkable
class Retags(Protocol):
    """Follows the tags of a changed file, before their first samples."""

    def retag(self, tags: Sequence[Tag], gone: Sequence[Tag]) -> None:
        """`tags` are new, or take the place of one in `gone`."""


@runtime_checkable
class Remembers(Protocol):
    """Has the samples of the past."""

    @property
    def history(self) -> History: ...


@runtime_checkable
class Audits(Protocol):
    """Keeps who wrote, commanded and acknowledged what."""

    def audit(self, at: int, event: str) -> None:
        """Keeps an outcome or an acknowledgement, as JSON; `at`: ns since 1970. Never blocks."""


@runtime_checkable
class Stores(Protocol):
    """Keeps values that clients write and no device has, as `plant.write_path.Store`."""

    def holds(self, tag: Tag) -> bool: ...

    async def write_group(self, values: Sequence[tuple[Tag, Value]]) -> Sequence[WriteResult]: ...


@runtime_checkable
class Logged(Protocol):
    """Has lines of its own."""

    def wire_logs(self) -> Mapping[str, WireLog]:
        """Returns the wire logs by line."""


# -- capabilities: what users see ----------------------------------------------------------------


@runtime_checkable
class Documented(Protocol):
    """Has documents in the status."""

    def documents(self) -> Mapping[str, Mapping[str, object]]:
        """Returns its documents by path."""


@runtime_checkable
class Faulty(Protocol):
    """Says itself what needs a person: a fault in status, page, metrics and commands."""

    def faults(self) -> Sequence[Fault]: ...


@runtime_checkable
class Republishes(Protocol):
    """Publishes what subscribers may have missed."""

    async def publish_all(self) -> None: ...


@runtime_checkable
class Shown(Protocol):
    """Has a place on the status page."""

    def shown(self) -> Mapping[str, Any]: ...


@runtime_checkable
class Listed(Protocol):
    """Has a list of alarms."""

    @property
    def changes(self) -> int:
        """Grows with each change."""

    def one(self, key: str) -> Mapping[str, Any] | None:
        """Returns the document of an alarm; None: there is no such alarm."""

    def page(self, state: str, after: str | None, most: int) -> Mapping[str, Any]:
        """Returns a page, after the alarm `after`. Any thread may call it. Raises `BadValue`."""

    def past(self, time_range: str, most: int) -> Sequence[Mapping[str, Any]]:
        """Returns the newest changes of a time, the newest first. Any thread may call it. Raises as
        `History.alarms`, and `NoHistory`."""


@runtime_checkable
class Routed(Protocol):
    """Answers HTTP requests."""

    def routes(self) -> Sequence[Any]:
        """Returns its routes, as aiohttp's `RouteDef`. A guard admits the requests before."""


def nothing(_why: str) -> None:
    """Does nothing: without a service there is nothing to start over."""


# -- making parts --------------------------------------------------------------------------------


class Others(Protocol):
    """The other parts, as far as a part may use them."""

    def each(self, capability: type[Any]) -> Sequence[Any]:
        """Returns the parts that work now and have the capability."""

    def audit(self, at: int, event: str) -> None:
        """Has the audit keep an event, as JSON; `at`: ns since 1970. Never blocks."""


class LoadedFile(Protocol):
    """The configuration file of this gateway, and its reloads."""

    @property
    def path(self) -> Path: ...

    @property
    def current(self) -> Config:
        """The file as the gateway has taken it over."""

    async def reload(self) -> Sequence[str]:
        """Reads the file again. Returns when it was taken over, or why it was not: a sentence for
        each mistake."""


@dataclass(frozen=True, slots=True)
class Core:
    """Everything that a part may use."""

    plant: Plant
    north: North
    history: Callable[[], History | None]
    others: Others
    start_over: Callable[[str], None] = nothing  # the gateway ends and starts again; the reason
    file: LoadedFile | None = None  # None: the configuration is in no file

    @property
    def config(self) -> Config:
        return self.plant.config


class Phase(Enum):
    """The time when a part runs. Parts of the first two also run while this gateway stands by."""

    KEEPING = "keeping"  # ends after Zenoh: it keeps the last outcomes
    SHOWING = "showing"  # ends before Zenoh
    ACTIVE = "active"  # begins before the lines, ends after Zenoh
    DRIVING = "driving"  # begins before the lines and ends before them: it sends requests


@dataclass(frozen=True, slots=True)
class Kind:
    """A part before it is made."""

    make: Callable[[Core], Part | None]  # None: the file does not want it
    phase: Phase = Phase.ACTIVE
    serves: type[Any] | None = None  # the capability that others ask for, although it is stopped
    documents: Sequence[DocumentKind] = ()  # the types of its documents
