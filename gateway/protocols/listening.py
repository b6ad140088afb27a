"""Listening to another master: requests and replies on a line where the gateway sends nothing.

A driver may have this capability. Its reader finds the frames of both directions in the bytes
(`DelimitedTrafficReader` those that begin with a character of their own);
`Pairing` decides which reply belongs to which request. When in doubt, it belongs to none: a value
that is not learned turns stale, and a value of another request would be shown as good.
"""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from gateway.protocols.driver import Span


@dataclass(frozen=True, slots=True)
class Asked:
    """A request of the other master, received whole."""

    station: int
    content: bytes  # the whole request: equal ones ask for the same
    size: int  # characters of its good reply
    shape: Hashable = None  # replies of one shape may be taken for each other; None: unknown
    error: Hashable = None  # the shape of an error reply
    read: Any = None  # the addresses, for `Listenable.learn`; None: nothing can be learned
    answered: bool = True  # False: a broadcast


@dataclass(frozen=True, slots=True)
class Told:
    """A reply of a station, received whole."""

    station: int
    shape: Hashable
    data: Any = None
    is_error: bool = False


@dataclass(frozen=True, slots=True)
class Noise:
    """Bytes that are no whole frame, or a frame of unknown meaning."""

    data: bytes


Heard = Asked | Told | Noise


class TrafficReader(Protocol):
    """Finds the frames of both directions. Does no I/O."""

    def feed(self, data: bytes, silence: float) -> list[Heard]:
        """Returns what `data` completes. `silence`: seconds without a byte before it."""


# The units of a span, of the data of a reply; None: the data cannot be those of the request.
Learn = Callable[[Any], Sequence[int] | None]


@runtime_checkable
class Listenable(Protocol):
    """A driver whose values can be learned from the traffic of another master."""

    @property
    def framing(self) -> Hashable:
        """Equal for devices whose frames one reader finds."""

    def traffic_reader(self, character: float) -> TrafficReader:
        """Returns a new reader. `character`: seconds of one character on the wire."""

    def learn(self, read: Any, span: Span) -> Learn | None:
        """Returns the decoder of the span; None if the read does not hold all of it."""


class Pairing:
    """Decides which request a reply belongs to.

    A reply is paired only with the request just before it: received whole, of the same station, in
    time, with nothing between the two. And a late reply to an older request must not fit: for
    `guard` seconds a request without a reply makes all replies doubtful that fit it too, unless it
    asks for the same. Noise may have hidden a request, and a reply to no request shows that one is
    repeated or late: then all replies are doubtful for so long.

    Stations reply in order. So a reply that fits no older request ends the doubt.
    """

    def __init__(self, guard: float, character: float) -> None:
        """`guard`: seconds until a late reply can no longer arrive. `character`: seconds of one."""
        self._guard = guard
        self._character = character
        self._last: tuple[Asked, float] | None = None  # the request that waits for its reply
        self._open: dict[int, list[tuple[Asked, float]]] = {}  # by station: without a reply
        self._doubt_until = float("-inf")
        self._quiet = False  # since the last reply that was paired, everything fitted
        self._extra = False

    def asked(self, asked: Asked, now: float) -> None:
        self._give_up()
        if asked.answered:
            self._last = asked, now

    def noise(self, now: float) -> None:
        self._give_up()
        self._quiet = False
        self._doubt_until = now + self._guard

    def told(self, told: Told, now: float, timeout: float) -> Asked | None:
        """Returns the request of this reply; None when in doubt. `timeout`: seconds, without those
        of the characters."""
        if self._last is None:
            self._extra = self._quiet
            self.noise(now)
            return None
        (asked, at), self._last = self._last, None
        late = now - at > timeout + (len(asked.content) + asked.size) * self._character
        if (
            late
            or now < self._doubt_until
            or told.station != asked.station
            or not _fits(told, asked)
        ):
            self._keep(asked, at)
            return None
        kept = self._open.pop(asked.station, [])
        older = [one for one in kept if now - one[1] <= self._guard and _fits(told, one[0])]
        if any(other.content != asked.content for other, _ in older):
            self._open[asked.station] = kept
            self._keep(asked, at)
            return None
        if older:  # it may be the reply to the oldest of these equal requests
            first = older[0][1]
            self._open[asked.station] = [one for one in kept if one[1] > first]
            self._keep(asked, at)
        self._quiet = True
        return asked

    def not_answered(self, asked: Asked, now: float) -> None:
        """Takes back a pair: the reply was not that of the request, whose own may still arrive."""
        self._keep(asked, now)

    def was_extra(self) -> bool:
        """Returns True if the last reply followed a paired one without a request between them.

        One of the two may have been the reply to an older request.
        """
        extra, self._extra = self._extra, False
        return extra

    def _give_up(self) -> None:
        """The last request gets no reply that is certainly its own."""
        if self._last is not None:
            self._keep(*self._last)
            self._last = None

    def _keep(self, asked: Asked, at: float) -> None:
        kept = self._open.setdefault(asked.station, [])
        kept[:] = [one for one in kept if at - one[1] <= self._guard]
        kept.append((asked, at))


def _fits(told: Told, asked: Asked) -> bool:
    shape = asked.error if told.is_error else asked.shape
    return shape is None or told.shape == shape


# Returns the frame at the beginning of the bytes and its size, with None in its place to skip it;
# 0 while it arrives, None if it is no frame.
Take = Callable[[bytes], tuple[Asked | Told | None, int] | int | None]

_BROKEN = 0.5  # seconds; a frame without end does not wait for the next one


class DelimitedTrafficReader:
    """A `TrafficReader` for frames that begin with one of `starts` and hold none of them."""

    def __init__(self, starts: bytes, longest: int, take: Take) -> None:
        self._starts = frozenset(starts)
        self._longest = longest
        self._take = take
        self._buffer = b""

    def feed(self, data: bytes, silence: float) -> list[Heard]:
        heard: list[Heard] = []
        if self._buffer and silence > _BROKEN:
            heard.append(Noise(self._buffer))
            self._buffer = b""
        self._buffer += data
        while self._buffer:
            found = self._take(self._buffer) if self._buffer[0] in self._starts else None
            if isinstance(found, tuple):
                if found[0] is not None:
                    heard.append(found[0])
                self._buffer = self._buffer[found[1] :]
                continue
            again = self._next_start()
            if found == 0 and not again and len(self._buffer) <= self._longest:
                break
            size = again or len(self._buffer)
            heard.append(Noise(self._buffer[:size]))
            self._buffer = self._buffer[size:]
        return heard

    def _next_start(self) -> int:
        """Returns the place of the next character that begins a frame; 0 if there is none."""
        places = (at for at, byte in enumerate(self._buffer) if at and byte in self._starts)
        return next(places, 0)
