"""The driver contract: what a protocol must be able to do, and all it may do to the world.

Two levels, neither of which does I/O. A `Codec` turns bytes into frames and back,
synchronously. A `Driver` turns frames into words with `async def`, but can do nothing
except talk on the turn it is handed.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable


class Unit(StrEnum):
    """What one address of an area holds."""

    BIT = "bit"
    WORD = "word"  # 16 bits
    DWORD = "dword"  # 32 bits by nature: Vigor and FX counters from C200 on


@dataclass(frozen=True, slots=True)
class Area:
    """A run of addresses of one kind in a device: Vigor's `D`, Modbus' `holding`."""

    name: str
    unit: Unit
    first: int
    last: int
    octal: bool = False
    readable: bool = True
    writable: bool = True


class Address(NamedTuple):
    """Where a tag lives, in the maker's numbering. `bit` picks one bit of a word."""

    area: str
    number: int
    bit: int | None = None


class Span(NamedTuple):
    """`size` neighbouring addresses of one area: what one exchange reads or writes."""

    area: str
    start: int
    size: int


class Cost(NamedTuple):
    """The characters one exchange puts on the wire, there and back."""

    request: int
    reply: int


F = TypeVar("F")
T = TypeVar("T")


class Codec(Protocol[F]):
    """Bytes <-> frames for one turn on the line; a fresh one for each turn."""

    def encode(self, frame: F) -> bytes: ...

    def feed(self, data: bytes) -> list[F]:
        """The frames completed by `data`. Noise before a frame is skipped.

        Raises `Garbled` when a frame is certainly damaged (a wrong sum, an endless frame).
        After that the codec is used no more.
        """


@runtime_checkable
class EndedByGap(Protocol[F]):
    """A codec whose frames may also be ended by a silence of `gap_timeout` seconds."""

    @property
    def gap_timeout(self) -> float | None:
        """None: no silence ends a frame."""

    def expire(self) -> list[F]:
        """The frames that the silence has ended. Raises as `feed`."""


class Talk(Protocol[F]):
    """One turn on the line: all that a driver can do to the world."""

    @property
    def may_echo(self) -> bool:
        """Whether a frame that equals our own may be its echo: nothing has shown the contrary."""

    async def tell(self, frame: F) -> None:
        """Send a frame that is not answered."""

    async def ask(self, frame: F, reply: int, answers: Callable[[F], T | None]) -> T:
        """Send `frame` and wait for its answer, of at most `reply` characters.

        Every frame heard is shown to `answers`, a pure function: it returns what the frame
        says, or None when the frame is no answer to this question (another station's, an
        echo, a late reply to something else), or raises `Refused`. Frames that are no
        answer are counted and passed over until the time-out. Several questions may be open at
        once on one turn (where answers carry a number); a frame goes to the first that takes it.

        Raises `NoReply`, `Garbled`, `LineDown`, and what `answers` raises.
        """


class Driver(Protocol[F]):
    """Frames <-> words for one device. A frozen dataclass whose fields are its YAML settings."""

    @property
    def protocol(self) -> str: ...

    @property
    def station(self) -> int: ...

    @property
    def areas(self) -> Mapping[str, Area]:
        """Every area of the device, by name."""

    @property
    def timing(self) -> "Timing": ...

    def address(self, text: str) -> Address:
        """The address as its maker writes it. Raises `ConfigError` saying what would be right."""

    def spell(self, address: Address) -> str:
        """The maker's spelling of an address: the inverse of `address`, for messages."""

    def cost(self, span: Span) -> Cost | None:
        """The characters that reading `span` in one exchange costs; None if that cannot be done.

        Exact, including what must be read around the span (bits come in eights). Whenever a
        span cannot be read in one exchange, no longer span around it can.
        """

    def write_cost(self, span: Span) -> Cost | None:
        """As `cost`, for writing."""

    def codec(self) -> Codec[F]: ...

    async def read(self, talk: Talk[F], span: Span) -> Sequence[int]:
        """The units of `span`: bits as 0 or 1, words as 0..65535, dwords as 0..2**32-1."""

    async def write(self, talk: Talk[F], span: Span, units: Sequence[int]) -> bool:
        """True when the device acknowledged the write, False where nobody ever acknowledges
        (a broadcast). Everything else raises."""

    async def resync(self, talk: Talk[F], doubt: Span | None, salt: int) -> int:
        """Ask something harmless whose answer cannot be taken for the answer to `doubt`.

        Also the cheapest proof of life. `salt` counts up by two, and is then the question's mark;
        a second question in the same resync has the mark after it. So the answers to earlier
        resyncs are not taken for the answer to this one either, as far as the protocol lets a
        question be marked: returned is from how many open questions, `doubt` among them, this
        one can be told. The values read are thrown away.

        Raises `Refused` where nothing but refusals came that may answer an older question.
        """


AnyDriver = Driver[Any]


@runtime_checkable
class ScatteredWriter(Protocol[F]):
    """A driver that can write several unconnected spans in one exchange (BT, WT)."""

    def scattered_write_cost(self, spans: Sequence[Span]) -> Cost | None:
        """None when these spans cannot go out in one exchange."""

    async def write_scattered(
        self, talk: Talk[F], parts: Sequence[tuple[Span, Sequence[int]]]
    ) -> bool: ...


@runtime_checkable
class Monitor(Protocol[F]):
    """A driver whose device remembers a list of addresses and reads it out cheaply (BM/MB, WM/MN).

    The device forgets its list at power-off: after any trouble, `register` again.
    """

    def monitor_cost(self, spans: Sequence[Span]) -> Cost | None:
        """What one read-out of the registered list costs; None if these cannot be registered."""

    async def register(self, talk: Talk[F], spans: Sequence[Span]) -> None: ...

    async def read_registered(
        self, talk: Talk[F], spans: Sequence[Span]
    ) -> list[Sequence[int]]: ...


@runtime_checkable
class Windowed(Protocol):
    """A driver whose answers carry a number, so that several questions may be open at once."""

    @property
    def window(self) -> int:
        """How many."""


@runtime_checkable
class NoReplyCauses(Protocol):
    """A driver that knows why its device may not reply at all."""

    @property
    def no_reply_causes(self) -> str:
        """The causes, in a sentence or two for people."""


@runtime_checkable
class StrayFrames(Protocol):
    """A driver that can explain stray frames: frames that are no reply to any request."""

    def from_this_station(self, frame: Any) -> bool:
        """True when the device itself sent the frame."""

    def describe_stray(self, frame: Any) -> str | None:
        """A phrase for the log; None for a frame that needs no explanation."""


@runtime_checkable
class Controllable(Protocol[F]):
    """A driver whose device takes commands: run, stop, loopback, model."""

    @property
    def controls(self) -> frozenset[str]: ...

    async def control(self, talk: Talk[F], command: str, argument: str) -> str:
        """What the device said. Raises `BadValue` for an argument that cannot be sent."""


@dataclass(frozen=True, slots=True)
class Timing:
    """A protocol's customary times in seconds; each can be set per device in the file."""

    reply_timeout: float = 0.5  # how long a station may take beyond the characters' own time
    turnaround: float = 0.005  # what a station usually takes, until it has been measured
    silence: float = 0.005  # quiet kept before a request
    silence_chars: float = 0.0  # quiet in characters; the longer of the two counts
    retries: int = 2  # reads that ended unclear are asked again so often
