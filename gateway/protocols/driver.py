"""The driver contract: the duties of a protocol, and the only things it may do.

Two levels, neither of which does I/O. A `Codec` turns bytes into frames and back,
synchronously. A `Driver` turns frames into words with `async def`; it can only send and
receive frames of the transaction it is given.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple, Protocol, Self, TypeVar, runtime_checkable

from gateway.values import Kind, Order


class Unit(StrEnum):
    """The contents of one address of an area."""

    BIT = "bit", 1
    WORD = "word", 0xFFFF
    DWORD = "dword", 0xFFFF_FFFF  # 32 bits by nature: Vigor and FX counters from C200 on

    largest: int  # of its values

    def __new__(cls, text: str, largest: int) -> Self:
        unit = str.__new__(cls, text)
        unit._value_, unit.largest = text, largest
        return unit


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

    def holds(self, span: "Span") -> bool:
        """Returns True if the span has addresses, and all of them are of this area."""
        return 0 < span.size <= self.last + 1 - span.start and self.first <= span.start


class Address(NamedTuple):
    """The place of a tag, in the maker's numbering. `bit` picks one bit of a word."""

    area: str
    number: int
    bit: int | None = None


class Span(NamedTuple):
    """`size` neighbouring addresses of one area: the data of one request."""

    area: str
    start: int
    size: int

    def overlaps(self, other: "Span") -> bool:
        """Returns True if the two have an address in common."""
        return (
            self.area == other.area
            and self.start < other.start + other.size
            and other.start < self.start + self.size
        )


class Cost(NamedTuple):
    """The characters of one request and its reply on the wire."""

    request: int
    reply: int


@dataclass(frozen=True, slots=True)
class Timing:
    """A protocol's default times in seconds; each can be set per device in the file."""

    reply_timeout: float = 0.5  # from the request to the reply, without the characters' own time
    turnaround: float = 0.005  # expected from the request to the reply, until it is measured
    silence: float = 0.005  # pause before a request
    silence_chars: float = 0.0  # pause in characters; the longer of the two counts
    retries: int = 2  # how often a read that ended unclear is repeated
    learn_silence: bool = False  # no standard asks for `silence`: polls may find out a shorter one


@dataclass(frozen=True, slots=True, kw_only=True)
class Traits:
    """Properties of a protocol that the configuration needs; most can be set in the file."""

    baudrate: int | None = 9600  # default of the line; None: over TCP, without a serial line
    format: str = "8N1"  # default of the line
    one_format: bool = False  # the manual names no other; the file must say that a device differs
    binary: bool = False  # frames need 8 data bits
    word_type: Kind = Kind.INT16  # default type of a word
    string_order: Order = Order.LOW_FIRST  # default byte order of a text
    numbered: bool = True  # devices have station numbers
    alone: bool = False  # a line has one device: no request or reply names a station
    dissector: str = ""  # the name of the protocol in Wireshark
    no_reply_causes: str = ""  # why a device may not reply at all, in a sentence or two for people

    @property
    def over_network(self) -> bool:
        return self.baudrate is None


EVERY_REQUEST = 0xFFFF  # `resync` returns it where its reply cannot be that to another request
PROOF = -1  # the probe token of a resync whose reply has a shape of its own, if there is one

F = TypeVar("F")
T = TypeVar("T")


class Codec(Protocol[F]):
    """Bytes <-> frames of one transaction; each transaction has a fresh one."""

    def encode(self, frame: F) -> bytes: ...

    def feed(self, data: bytes) -> list[F]:
        """Returns the frames completed by `data`. Noise before a frame is skipped.

        Raises `Garbled` when a frame is certainly damaged (a wrong sum, an endless frame).
        The codec is not used again after that.
        """


@runtime_checkable
class EndedByGap(Protocol[F]):
    """A codec whose frames may also be ended by a silence of `gap_timeout` seconds."""

    @property
    def gap_timeout(self) -> float | None:
        """None: no silence ends a frame."""

    @property
    def pending(self) -> int:
        """The number of bytes kept: part of a frame."""

    def expire(self) -> list[F]:
        """Returns the frames that the silence has ended. Raises as `feed`."""


class Talk(Protocol[F]):
    """One transaction: the only things that a driver can do to the outside."""

    @property
    def may_echo(self) -> bool:
        """True while a frame equal to the request may be its echo."""

    async def tell(self, frame: F) -> None:
        """Sends a frame that has no reply."""

    async def ask(self, frame: F, reply: int, answers: Callable[[F], T | None]) -> T:
        """Sends `frame` and waits for its reply, of at most `reply` characters.

        Every received frame is given to `answers`, a pure function: it returns the contents of
        the frame, or None when the frame is not the reply to this request (another station's,
        an echo, a late reply to an older request), or raises `Refused`. Frames that are not the
        reply are counted and skipped until the time-out. Several requests may be outstanding in
        one transaction (where replies carry a number); a frame goes to the first that takes it.

        Raises `NoReply`, `Garbled`, `LineDown`, and the errors of `answers`.
        """


class Addressing(Protocol):
    """The addresses of one device, and what requests for them cost."""

    @property
    def protocol(self) -> str: ...

    @property
    def station(self) -> int: ...

    @property
    def traits(self) -> Traits: ...

    @property
    def timing(self) -> Timing: ...

    @property
    def areas(self) -> Mapping[str, Area]:
        """Every area of the device, by name."""

    def address(self, text: str) -> Address:
        """Parses an address as its maker writes it. Raises `ConfigError` with a correct example."""

    def spell(self, address: Address) -> str:
        """Writes an address as its maker does: the inverse of `address`."""

    def cost(self, span: Span) -> Cost | None:
        """Returns the cost of reading `span` in one request; None if that is impossible.

        Exact, with all that must be read around the span (bits are read in eights). If a span
        cannot be read in one request, no longer span around it can. For words inside their area
        only the size counts. The station number counts only where it changes the areas.
        """

    def write_cost(self, span: Span) -> Cost | None:
        """As `cost`, for writing."""


class Driver(Addressing, Protocol[F]):
    """Frames <-> words for one device. A frozen dataclass whose fields are its YAML settings."""

    def codec(self) -> Codec[F]: ...

    async def read(self, talk: Talk[F], span: Span) -> Sequence[int]:
        """Returns the units of `span`: bits as 0 or 1, words 0..65535, dwords 0..2**32-1."""

    async def write(self, talk: Talk[F], span: Span, units: Sequence[int]) -> bool:
        """Returns True when the device acknowledged the write, False where it never does
        (a broadcast). Raises in every other case."""

    async def resync(
        self,
        talk: Talk[F],
        outstanding: Span | None,
        probe_token: int,
        spans: Sequence[Span] = (),
    ) -> int:
        """Sends a harmless request whose reply cannot be the reply to the `outstanding` read.

        `spans`: readable addresses of the file, the likeliest first. A device may be silent about
        all others, so a resync by a read stays inside one of them. Where no read inside them
        differs from the outstanding one, the resync may send that read again, and returns 0.
        It is also the cheapest way to see that the device is online. `probe_token` marks the
        request and grows by two with each resync; a second request in the same resync is marked
        with the number after it. So a reply to an earlier resync is not taken for the reply to
        this one either, as far as the protocol can mark a request. Values are discarded. Returns
        the number of outstanding requests, with `outstanding`, whose replies differ from its own,
        or `EVERY_REQUEST`.

        Raises `Refused` where only error replies arrived that may belong to an older request.
        """


AnyDriver = Driver[Any]
