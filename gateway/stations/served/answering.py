"""The contract of an answering machine: bytes of the wire in, at most one reply out."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from gateway.protocols.driver import AnyDriver
from gateway.stations.served.echo import Echo
from gateway.stations.store import Store, Written

# Fewer bytes behind a request are noise of the wire; more are the beginning of the next request.
NOISE = 2
_CHARACTERS = 4  # a master that is slow pauses for so many within a request


class Done(NamedTuple):
    """One request of the master to a station of this line."""

    station: int
    refused: str = ""  # the code of the error reply
    write: bool = False
    written: Written = ()  # the tags that it changed, with their values


class Heard(NamedTuple):
    """The result of some bytes. A reply is sent `delay` seconds after them, if nothing follows."""

    reply: bytes = b""
    delay: float = 0.0
    done: tuple[Done, ...] = ()
    stale: int = 0  # requests that later bytes have followed: neither carried out nor answered
    lost: bool = False  # where the next frame begins cannot be found any more
    more: bool = False  # another request waits: hear no bytes for it
    echo: bool = False  # our own reply came back, and nothing else: no request follows


SILENCE = Heard()


class Answerer(Protocol):
    """The stations of one line, towards one master. Synchronous; does no I/O.

    It ignores what is addressed to other stations and what they reply. A request that other
    bytes follow is not carried out: the master no longer waits for its reply, and would take it
    for the reply to a later request.
    """

    def hear(self, data: bytes, now: float) -> Heard:
        """Takes any piece of the bytes on the wire, and carries out one request at most. `now`:
        seconds, by any clock."""


class Answering(NamedTuple):
    """One station: its settings and its data."""

    driver: AnyDriver
    registers: Store


@dataclass(frozen=True, slots=True, kw_only=True)
class Wire:
    """The properties of the wire. Times in seconds."""

    character: float  # the duration of one character
    silence: float = 0.0  # before a reply
    gap: float | None = None  # the longest pause within a request; None: `usual`
    echo: Echo = field(default_factory=Echo)

    def usual(self, adapter: float) -> float:
        """Returns the longest pause within a request. `adapter`: what an adapter adds to it."""
        return adapter + _CHARACTERS * self.character

    def pause(self, adapter: float) -> float:
        """Returns the pause after which a request begins again: as the file says, or `usual`."""
        return self.usual(adapter) if self.gap is None else self.gap


Stations = Mapping[int, Answering]
