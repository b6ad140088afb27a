"""What the Zenoh side needs from the rest of the gateway, and nothing more."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Literal, Protocol

from gateway.tags import Sample, Tag, WriteResult
from gateway.values import Value


class Device(Protocol):
    """One device and its tags."""

    @property
    def name(self) -> str: ...

    @property
    def tags(self) -> Iterable[Tag]: ...

    @property
    def blocks(self) -> bool | Literal["only"]:
        """Whether each scan is published as one `@block`: also, or only so."""


class Plant(Protocol):
    """The gateway below: what it knows, and who writes. All but `sample` on the event loop."""

    def devices(self) -> Iterable[Device]: ...

    def tag(self, key: str) -> Tag | None:
        """By `device/name`."""

    def sample(self, tag: Tag) -> Sample:
        """What is known now. Also called from the answering threads: one look-up, nothing else.

        It must be updated before `Northbound.publish` is called, or a reader could keep the
        older of two values.
        """

    def told(self, samples: Sequence[Sample]) -> None:
        """They are about to be published again: what is worth telling is reckoned from them."""

    async def write(self, tag: Tag, value: Value) -> WriteResult:
        """Returns when the device has acknowledged. Raises `GatewayError`; `Busy` and `BadValue`
        only when nothing was sent. Cancelled when nobody waits any more."""

    def is_fresh(self, tag: Tag, max_age: float) -> bool:
        """Whether what is known is younger than `max_age` seconds, or nothing could be read."""

    async def fresh(self, tag: Tag, max_age: float) -> Sample:
        """What is known where it `is_fresh`, or what the device says when it is asked from now
        on. Raises `Busy` when it could not be asked in time."""

    def status(self) -> Mapping[str, Mapping[str, object]]:
        """Documents by path: `status`, `lines/<line>`, `devices/<device>`."""


class History(Protocol):
    """Samples of the past, by Zenoh's own time ranges; `now`: ns since 1970, when it was asked."""

    def samples(self, tag: Tag, time_range: str, limit: int | None, now: int) -> Iterator[Sample]:
        """In the order of time, the first `limit`; called from an answering thread. Raises
        `BadValue` for a range that cannot be understood, and `Busy`, also in the middle, when
        the past cannot be read now."""

    def writes(self, time_range: str, limit: int | None, now: int) -> Iterator[str]:
        """What was told of writes and commands, as on the `writes` key. Raises likewise."""
