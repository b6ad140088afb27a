"""The plant, the history and the Zenoh side, as far as others of them may use them."""

from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal, Protocol, runtime_checkable

from gateway.contract.past.buckets import Bucket, Now
from gateway.contract.past.history_query import HistoryQuery
from gateway.contract.payload import GroupResult
from gateway.contract.problems import Failure
from gateway.engine.jobs.requests import CommandResult, Peeked
from gateway.errors import GatewayError
from gateway.line.send_permit import SendPermit
from gateway.line.wire_log import WireLog
from gateway.tags import Sample, Tag, WriteResult
from gateway.tags.recorded import Recorded, RecordedQuery
from gateway.values import Value


class Device(Protocol):
    """One device and its tags."""

    @property
    def name(self) -> str: ...

    @property
    def tags(self) -> Iterable[Tag]: ...

    @property
    def blocks(self) -> bool | Literal["only"]:
        """True: each scan is also published as one `@block`. "only": single values are not."""

    @property
    def control(self) -> bool:
        """Commands are permitted."""

    @property
    def templates(self) -> tuple[str, ...]:
        """The templates that the file uses for it."""


class Plant(Protocol):
    """The devices, their samples, writes and commands. All but `sample` on the event loop."""

    @property
    def duty(self) -> SendPermit: ...

    def devices(self) -> Iterable[Device]: ...

    def wire_logs(self) -> Mapping[str, WireLog]:
        """Returns the wire logs by line."""

    def begin(self) -> None:
        """Notes that this gateway is active now. Called before the first sample is served."""

    def tag(self, key: str) -> Tag | None:
        """Finds a tag by `device/name`."""

    def sample(self, tag: Tag) -> Sample:
        """Returns the current sample. Answering threads call it too: one look-up, nothing else.

        The plant updates it before it calls `Northbound.publish`; otherwise a reader could keep
        the older of two values.
        """

    def mark_published(self, samples: Sequence[Sample]) -> None:
        """Notes samples that are about to be published again: later changes are measured against
        them."""

    async def write_group(
        self, values: Sequence[tuple[Tag, Value]], within: float, patience: float
    ) -> Sequence[WriteResult | GatewayError]:
        """Writes tags of one device in their order. Returns the outcome of each, at the latest
        after `patience` seconds: what has not ended then is `Unclear`. After the first that is not
        done the others are `NotSent`. After `within` seconds nothing is sent any more. Raises
        `GatewayError`; `Busy` and `BadValue` only when nothing was sent. Cancelled when the client
        no longer waits."""

    def commands(self) -> Mapping[str, frozenset[str]]:
        """By device: the commands of its protocol, allowed or not."""

    def speaker(self, line: str) -> str:
        """Returns the device that sends a command to all stations of a line. Raises `BadValue`."""

    async def control(
        self, device: str, command: str, argument: str, within: float
    ) -> CommandResult:
        """Returns the device's answer. Raises `GatewayError`; `BadValue` before anything is
        sent."""

    async def peek(self, device: str, text: str) -> Peeked:
        """Reads any addresses once, such as `D100..D119`. Raises `GatewayError`; `BadValue` before
        anything is sent."""

    def dialling(self, device: str) -> float:
        """Returns the seconds that a request may wait for a telephone call; 0: for none."""

    def is_fresh(self, tag: Tag, max_age: float) -> bool:
        """True if the current sample is younger than `max_age` seconds, or cannot be read now."""

    async def fresh(self, tag: Tag, max_age: float) -> Sample:
        """Returns the current sample if it `is_fresh`, otherwise reads the device. Raises `Busy`
        when the line did not get to it in time."""

    def status(self) -> Mapping[str, Mapping[str, object]]:
        """Documents by path: `status`, `lines/<line>`, `devices/<device>`."""


class History(Protocol):
    """Recorded samples, found by Zenoh's time ranges. `now`: ns since 1970, when the query came."""

    def samples(self, tag: Tag, time_range: str, limit: int | None, now: int) -> Iterator[Sample]:
        """The first `limit` samples in the order of time; called from an answering thread.

        Raises `BadValue` for a range that cannot be parsed, and `Busy`, also in the middle, when
        the file cannot be read now, and `Damaged` at the end when a part of it was left out.
        """

    def buckets(
        self, tag: Tag, question: HistoryQuery, now: Now, pause: Callable[[], None]
    ) -> Iterator[Bucket]:
        """The buckets of a tag in the order of time. Calls `pause` often. Raises like `samples`."""

    def newest(
        self, tag: Tag, question: HistoryQuery, now: int, pause: Callable[[], None]
    ) -> Iterator[Sample]:
        """The last samples of a tag in the order of time. Raises like `samples`."""

    def as_recorded(self, query: RecordedQuery, pause: Callable[[], None]) -> Recorded:
        """Calls `pause` at least every few milliseconds. Raises `BadValue`, `Busy`."""

    def writes(self, time_range: str, limit: int | None, now: int) -> Iterator[str]:
        """Outcomes of writes and commands, as on the `writes` key. Raises like `samples`."""

    def alarms(self, time_range: str, limit: int | None, now: int) -> Iterator[str]:
        """Changes of alarms, as JSON in the order of time. Raises like `samples`."""

    def record_alarm(self, time: int, change: str) -> None:
        """Records one change; `time`: ns since 1970. Never blocks."""

    def record_write(self, time: int, outcome: str, *, refused: bool) -> None:
        """Records one outcome, as on the `writes` key; `time`: ns since 1970. `refused`: nothing
        was sent. Never blocks."""


@runtime_checkable
class Keyed(Protocol):
    """A part with documents of its own, below `@gateway/<name>/<name of the part>/`."""

    def entries(self) -> Sequence[tuple[str, Callable[[], bytes]]]:
        """Returns the path of each document, and what makes it. Any thread may call both."""

    def recorded(self, time_range: str, now: int) -> Iterator[tuple[str, str]]:
        """Yields recorded documents with their paths, as JSON. Raises as `History.samples`, and
        `NoHistory`. Any thread may call it."""

    async def order(self, path: str, data: bytes, by: str | None) -> bytes:
        """Carries out the order of a client that may write, and returns the new document.

        Raises `GatewayError`; what it returns is kept across a restart.
        """


class Parts(Protocol):
    """The parts of the service, as far as Zenoh needs them."""

    def has_keys(self, part: str) -> bool:
        """True for a part with documents of its own, also while it does not work."""

    def keyed(self, part: str) -> Keyed:
        """Returns the part. Raises `Busy` while it does not work."""

    def history(self) -> History | None:
        """Returns the history; None: none is kept. Raises `Busy` while it does not work."""

    def audit(self, at: int, event: str) -> None:
        """Has the audit keep an outcome, as JSON; `at`: ns since 1970. Never blocks."""

    async def publish_all(self) -> None:
        """Publishes what subscribers of the parts may have missed."""


class North(Protocol):
    """The Zenoh side, as far as parts use it. Belongs to the event loop."""

    @property
    def is_ready(self) -> bool:
        """True when the gateway serves its plant on Zenoh."""

    async def documents(self, max_age: float) -> Mapping[str, Mapping[str, Any]]:
        """Returns the status documents by path, at most `max_age` seconds old."""

    def reports(self) -> Iterable[tuple[str, bytes, float]]:
        """Asks all gateways under the prefix; returns key, payload and arrival (s since 1970) of
        each report. Blocks. Raises `GatewayError`."""

    def publish_latest(self, path: str, make: Callable[[], bytes]) -> None:
        """Publishes the document at `@gateway/<name>/<path>`. Never blocks: the publishing thread
        calls `make`, and only for the last of several."""

    def write_own(
        self, tag: Tag, value: Value, by: str, within: float, *, repeated: bool = True
    ) -> Awaitable[WriteResult]:
        """Writes for a part, named `by`. After `within` seconds nothing is sent any more.
        `repeated`: the audit tells only an end that differs from the last one. Raises
        `GatewayError`."""

    def deny_own(self, tag: Tag, value: Value | None, by: str, why: str) -> None:
        """Audits a write that a part named `by` does not carry out."""

    async def write(
        self, tag: str, data: bytes, by: str, arrived: float
    ) -> WriteResult | Failure | GroupResult:
        """Writes for the client `by`, whom a part has admitted. `tag`: `device/name`; `data`: the
        payload as on Zenoh; `arrived`: by the loop's clock."""

    async def order(
        self, part: str, path: str, data: bytes, by: str, arrived: float
    ) -> bytes | Failure:
        """Has a part carry out an order of the client `by`, as `write` does."""
