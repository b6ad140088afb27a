"""The optional capabilities of a driver: a class has one by having its methods.

The callers ask with `isinstance`; a driver without the capability needs nothing for it.
"""

from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, TypeVar, runtime_checkable

from gateway.errors import RefusedOther
from gateway.protocols.driver import Cost, Span, Talk

F = TypeVar("F")


@runtime_checkable
class ScatteredWriter(Protocol[F]):
    """A driver that can write several separate spans with one request (BT, WT)."""

    def scattered_write_cost(self, spans: Sequence[Span]) -> Cost | None:
        """Returns None when these spans do not fit one request."""

    async def write_scattered(
        self, talk: Talk[F], parts: Sequence[tuple[Span, Sequence[int]]]
    ) -> bool: ...


@runtime_checkable
class NamesRegisters(Protocol):
    """A driver whose data are also the numbers of a Modbus table."""

    def named(self, table: str, number: int) -> str:
        """Returns the address, as the file writes it, of a number of `coil`, `discrete`, `input`
        or `holding`. Raises `ConfigError`."""


@runtime_checkable
class WritesAround(Protocol):
    """A driver whose writes of some spans also write addresses around them, as just read."""

    def writes_around(self, span: Span) -> bool:
        """Returns True if a write of the span writes more than the span."""


@runtime_checkable
class ChangesBits(Protocol[F]):
    """A driver whose device may change some bits of a word by itself, and leave the others."""

    def changes_bits(self, span: Span) -> bool:
        """Returns True if it can be tried for the word of this span."""

    async def change_bits(self, talk: Talk[F], span: Span, mask: int, bits: int) -> bool:
        """Changes the bits of `mask` to those of `bits`, as `write` does.

        Raises `Refused` with `unexecuted` where the device lacks the function.
        """


@runtime_checkable
class Monitor(Protocol[F]):
    """A driver whose device stores a list of addresses and reads it cheaply (BM/MB, WM/MN).

    The device loses its list at power-off: after any error, `register` it again.
    """

    def monitor_cost(self, spans: Sequence[Span]) -> Cost | None:
        """Returns the cost of reading the list; None if these spans cannot be registered."""

    async def register(self, talk: Talk[F], spans: Sequence[Span]) -> None: ...

    async def read_registered(
        self, talk: Talk[F], spans: Sequence[Span]
    ) -> list[Sequence[int]]: ...


@runtime_checkable
class Windowed(Protocol):
    """A driver whose replies carry a number: several requests may be outstanding."""

    @property
    def window(self) -> int:
        """The most outstanding requests."""


@runtime_checkable
class StrayFrames(Protocol):
    """A driver that can explain stray frames: frames that are no reply to any request."""

    def describe_stray(self, frame: Any) -> str | None:
        """Returns a phrase for the log; None for a frame that needs no explanation."""


@runtime_checkable
class BehindGateway(Protocol):
    """A driver of stations that a gateway on the network may poll for us."""

    def is_absence(self, frame: Any) -> bool:
        """Returns True if the gateway says with it that the station did not reply."""


@runtime_checkable
class LooseRefusals(Protocol):
    """A driver whose error replies name a request, and some devices name the wrong one."""

    def refusal_of_another(self, frame: Any) -> RefusedOther | None:
        """Returns an error reply of this station, to another request than was sent, as an error."""


@runtime_checkable
class UnnumberedReplies(Protocol):
    """A driver whose replies name no request: they differ by shape only, kind and length."""

    @property
    def unnumbered(self) -> bool:
        """False where the settings give each reply a number."""

    def cost(self, span: Span) -> Cost | None:
        """As in `Driver`."""

    def reply_shape(self, span: Span) -> Hashable:
        """Returns the shape of the reply to a read of `span`.

        Replies of different shapes are never taken for each other.
        """

    def write_shapes(self, span: Span, units: Sequence[int]) -> Sequence[Hashable]:
        """Returns the shapes of all replies to a write of `span`, in their order."""

    def resync_shape(
        self, outstanding: Span | None, probe_token: int, spans: Sequence[Span] = ()
    ) -> Hashable:
        """Returns the shape of the reply to `resync`; None where no other reply can have it.

        For the token `PROOF`: None where no read has a shape of its own.
        """

    def is_reply(self, frame: Any) -> bool:
        """Returns True for a reply of this station: for no request and no unsolicited frame."""


@runtime_checkable
class Controllable(Protocol[F]):
    """A driver whose device accepts commands: run, stop, loopback, model."""

    @property
    def controls(self) -> frozenset[str]: ...

    @property
    def broadcast_commands(self) -> frozenset[str]:
        """The commands that go to all stations of the line, and get no reply."""

    async def control(self, talk: Talk[F], command: str, argument: str) -> str:
        """Returns the reply of the device. Raises `BadValue` for an argument it cannot send."""


@runtime_checkable
class Identifies(Protocol[F]):
    """A driver whose device tells which one it is."""

    @property
    def identity_names(self) -> Collection[str]:
        """The names that it may tell: vendor, model, serial."""

    async def identify(self, talk: Talk[F], names: Collection[str]) -> Mapping[str, Sequence[str]]:
        """Returns all texts that the device tells for each of the names.

        Raises `Refused` if it lacks the function.
        """


@runtime_checkable
class EchoConflict(Protocol):
    """A driver with a setting that does not work on a line that echoes."""

    @property
    def echo_conflict(self) -> tuple[str, str] | None:
        """The setting and the reason; None where the settings of this device work."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanHints:
    """Settings of `scan` for a protocol."""

    formats: Sequence[str] = ("8N1",)  # of a serial line, the most likely first
    stations: range = range(1, 32)  # default of the command
    variants: Sequence[Mapping[str, object]] = ({},)  # YAML settings to try at each station


@runtime_checkable
class Scannable(Protocol):
    """A driver class whose stations `scan` can look for."""

    scan_hints: ClassVar[ScanHints]
