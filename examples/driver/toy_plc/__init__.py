"""A driver in a package of its own, and the simulated device for it.

The toy device holds numbers N0 to N99. `R5 N7` reads one at station 5, `W5 N7 42` writes one;
the reply is `=5 N7 42`, or `!5 N7` where the number does not exist.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

from gateway.errors import ConfigError, Refusal, Refused
from gateway.protocols.capabilities import ScanHints
from gateway.protocols.driver import Address, Area, Cost, Span, Talk, Timing, Traits, Unit
from gateway.stations import registry
from gateway.stations.station import Memory
from gateway.values import Kind

NUMBERS = Area("N", Unit.WORD, 0, 99)


class ToyCodec:
    """One frame is one line of text."""

    def __init__(self) -> None:
        self._buffer = b""

    def encode(self, frame: str) -> bytes:
        return frame.encode() + b"\n"

    def feed(self, data: bytes) -> list[str]:
        *lines, self._buffer = (self._buffer + data).split(b"\n")
        return [line.decode("ascii", "replace") for line in lines]


@dataclass(frozen=True, slots=True, kw_only=True)
class Toy:
    """The driver; its fields are its settings in the file."""

    protocol: Literal["toy"] = "toy"
    station: int = 1
    upper: bool = True  # the letters of requests

    scan_hints: ClassVar = ScanHints(
        formats=("8E2",), stations=range(3, 10), variants=({"upper": False}, {"upper": True})
    )

    def __post_init__(self) -> None:
        if not 1 <= self.station <= 9:
            raise ConfigError(f"station {self.station} is not 1..9")

    @property
    def traits(self) -> Traits:
        return Traits(baudrate=4800, format="8E2", binary=True, word_type=Kind.UINT16)

    @property
    def timing(self) -> Timing:
        return Timing(reply_timeout=0.2)

    @property
    def areas(self) -> Mapping[str, Area]:
        return {"N": NUMBERS}

    def address(self, text: str) -> Address:
        if text[:1] != "N" or not text[1:].isdecimal() or int(text[1:]) > NUMBERS.last:
            raise ConfigError(f"{text} is no address: write N0 to N{NUMBERS.last}")
        return Address("N", int(text[1:]))

    def spell(self, address: Address) -> str:
        return f"N{address.number}"

    def cost(self, span: Span) -> Cost | None:
        return Cost(7, 13) if span.size == 1 else None

    def write_cost(self, span: Span) -> Cost | None:
        return Cost(13, 13) if span.size == 1 else None

    def codec(self) -> ToyCodec:
        return ToyCodec()

    async def read(self, talk: Talk[str], span: Span) -> Sequence[int]:
        return [await self._ask(talk, "R", f"N{span.start}")]

    async def write(self, talk: Talk[str], span: Span, units: Sequence[int]) -> bool:
        await self._ask(talk, "W", f"N{span.start} {units[0]}")
        return True

    async def resync(
        self,
        talk: Talk[str],
        outstanding: Span | None,
        probe_token: int,
        spans: Sequence[Span] = (),
    ) -> int:
        number = probe_token % 100
        if outstanding is not None and number == outstanding.start:
            number = (number + 1) % 100
        await self._ask(talk, "R", f"N{number}")
        return 99

    async def _ask(self, talk: Talk[str], letter: str, body: str) -> int:
        name = body.split()[0]
        expected = f"{self.station} {name}"

        def accept(frame: str) -> int | None:
            if frame == f"!{expected}":
                raise Refused(f"{name} does not exist", code="!", refusal=Refusal.ADDRESS)
            begin = f"={expected} "
            return int(frame.removeprefix(begin)) if frame.startswith(begin) else None

        command = letter if self.upper else letter.lower()
        return await talk.ask(f"{command}{self.station} {body}", 13, accept)


class ToyStation:
    """The simulated device."""

    def __init__(self, station: int, upper: bool) -> None:
        self.memory = Memory([("N", NUMBERS.first, NUMBERS.last)])
        self._station = station
        self._letters = "RW" if upper else "rw"
        self._codec = ToyCodec()

    def hear(self, data: bytes, now: float) -> list[bytes]:
        replies = [self._reply(frame, now) for frame in self._codec.feed(data)]
        return [self._codec.encode(reply) for reply in replies if reply]

    def _reply(self, frame: str, now: float) -> str:
        command, name, *value = frame.split()
        if command[0] not in self._letters or command[1:] != str(self._station):
            return ""
        number = int(name[1:])
        if not self.memory.holds("N", number):
            return f"!{self._station} {name}"
        if value:
            self.memory.write("N", number, [int(value[0])])
        [held] = self.memory.read("N", number, 1, now)
        return f"={self._station} {name} {held}"


def toy_station(driver: Toy) -> ToyStation:
    return ToyStation(driver.station, driver.upper)


registry.register("toy", toy_station)
