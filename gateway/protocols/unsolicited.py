"""Unsolicited frames: values that a device sends without a request.

A driver may have this capability. The engine gives the listener the bytes and the time, calls
`tick` when it is `due`, and sends the replies.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from gateway.errors import Garbled
from gateway.protocols.driver import Span
from gateway.values.numerals import Scalar


@dataclass(frozen=True, slots=True)
class UnsolicitedFrame:
    """One decoded frame: its fields, each a value or the damage that hides it.

    A field is named as `Driver.spell` writes its address. `reply` is the frame to send back at
    once, as the driver's codec encodes it; None: the device expects no reply.
    """

    message: str
    values: Mapping[str, Scalar | Garbled]
    reply: Any = None


@dataclass(frozen=True, slots=True)
class Stale:
    """These fields have not arrived within their `stale_after`."""

    fields: frozenset[str]


# `Garbled`: damaged bytes, or a frame of unknown meaning. No unsolicited field is known after it.
UnsolicitedEvent = UnsolicitedFrame | Garbled | Stale


class UnsolicitedListener(Protocol):
    """Decodes the unsolicited frames of one device while its port is open. Does no I/O.

    Times are seconds on the clock of the line.
    """

    @property
    def due(self) -> float | None:
        """The time of the next `tick`; None: no time-out is running."""

    @property
    def busy_until(self) -> float | None:
        """The latest time of the next byte of an incomplete frame; None between two frames."""

    @property
    def all_stale(self) -> bool:
        """True when every field that can become stale is stale."""

    def received(self, data: bytes, now: float) -> Collection[UnsolicitedEvent]:
        """Decodes bytes that arrived at `now` outside of a transaction."""

    def framed_as(self, driver: object) -> bool:
        """Returns True if a transaction of this driver finds the frames of the device too."""

    def unmatched(self, frame: Any, now: float) -> Collection[UnsolicitedEvent]:
        """Decodes a frame that arrived during a transaction and is not its reply.

        Its first characters may have been lost while the gateway sent.
        """

    def tick(self, now: float) -> Collection[UnsolicitedEvent]:
        """Ends frames by silence, and marks fields as stale."""

    def restart(self, now: float, *, whole: bool) -> None:
        """Discards an incomplete frame, because other frames were on the line.

        `whole`: the last was a whole reply with the same framing, and nothing followed it.
        """


@runtime_checkable
class Unsolicited(Protocol):
    """A driver whose devices may send unsolicited frames."""

    @property
    def sends_unsolicited(self) -> bool:
        """True when this device, as configured, sends unsolicited frames."""

    @property
    def unsolicited(self) -> Collection[str]:
        """The fields of its unsolicited frames, named as `Driver.spell` writes their addresses."""

    def unsolicited_only(self, span: Span) -> bool:
        """True when the values of the span arrive unsolicited and cannot be polled."""

    def listener(self, now: float) -> UnsolicitedListener:
        """Returns a new listener. `now`: the port was opened, possibly in the middle of a frame."""
