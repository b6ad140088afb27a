"""Which stations answer on a wire, and how: what to find out first of a line nobody knows."""

import asyncio
from collections.abc import Awaitable, Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Literal

from gateway.config import parsers
from gateway.errors import ConfigError, Garbled, LineDown, Refused, Unclear
from gateway.line.clock import Clock
from gateway.line.transaction import Turn
from gateway.line.wire_log import Recorder
from gateway.planning.wire_timing import WireTiming, character_bits
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.driver import AnyDriver
from gateway.protocols.modbus import ModbusAscii, ModbusRtu, ModbusTcp
from gateway.protocols.vigor import Vigor
from gateway.transport import (
    Port,
    Receiver,
    SerialSettings,
    SimulatorAddress,
    TcpAddress,
    open_port,
    parse_port,
)

BAUDS = (9600, 19200, 38400, 115200, 57600, 4800)  # the likely ones first
FORMATS = {
    "vigor": ("7E1", "8N1"),
    "computer-link": ("7E1", "8N1", "8E1", "7O1"),
    "modbus-rtu": ("8N1", "8E1", "8O1", "8N2"),
    "modbus-ascii": ("7E1", "8N1", "7O1", "7N2"),
    "modbus-tcp": (),
}
# Where a PLC with a port to itself is station 0. In Modbus that is everybody: nobody answers.
FROM_ZERO = ("vigor", "computer-link")
# After bytes that made no sense: seconds without one before the next question, and at most.
QUIET, LONGEST_NOISE = 0.02, 0.5
Open = Callable[[SerialSettings | None, Receiver], Awaitable[Port]]


@dataclass(frozen=True, slots=True)
class Plan:
    """Whom to ask, and how."""

    open_port: Open
    protocol: str
    stations: Sequence[int]
    serial: Sequence[SerialSettings | None]  # None: set on a device server, nobody can say
    timeout: float  # seconds a station may take beyond the characters' own time


@dataclass(frozen=True, slots=True)
class Found:
    """A station that answered. `settings` are its protocol's, as the file writes them; `refusal`
    is what it said where it said "no" to all of them."""

    serial: SerialSettings | None
    driver: AnyDriver
    settings: dict[str, object]
    refusal: str = ""


@dataclass(slots=True)
class Report:
    """What came of a scan: stations in the order found, and where something else was heard."""

    found: list[Found] = field(default_factory=list)
    noises: dict[SerialSettings | None, str] = field(default_factory=dict)


def ways(protocol: str, station: int) -> Iterator[tuple[AnyDriver, dict[str, object]]]:
    """How a station may speak the protocol. Raises `ConfigError` for one that cannot be sought."""
    match protocol:
        case "vigor":
            yield Vigor(station=station), {}
        case "computer-link":
            forms: tuple[Literal[1, 4], ...] = (1, 4)
            for form, summed in product(forms, (True, False)):
                driver = ComputerLink(station=station, frame_format=form, sum_check=summed)
                yield driver, {"frame_format": form, "sum_check": summed}
        case "modbus-rtu":
            yield ModbusRtu(station=station), {}
        case "modbus-ascii":
            yield ModbusAscii(station=station), {}
        case "modbus-tcp":
            yield ModbusTcp(station=station), {}
        case _:
            raise ConfigError(f"{protocol} cannot be sought: use one of {', '.join(FORMATS)}")


def planned(
    port: str,
    protocol: str,
    stations: str | None = None,
    bauds: str | None = None,
    formats: str | None = None,
    timeout: str = "200ms",
) -> Plan:
    """As a person types it. Raises `ConfigError`."""
    where = parse_port(port)
    if stations is None:
        stations = "0-31" if protocol in FROM_ZERO else "1-31"
    numbers = list(dict.fromkeys(_numbers(stations)))
    for number in numbers:
        next(ways(protocol, number))
    if isinstance(where, SimulatorAddress):
        raise ConfigError("simulated PLCs need no scan: they are what the file says")
    if protocol == "modbus-tcp" and not isinstance(where, TcpAddress):
        raise ConfigError("modbus-tcp is spoken at tcp://host:port")
    serial: list[SerialSettings | None] = [
        SerialSettings(parsers.baudrate(baud), parsers.serial_format(form))
        for form, baud in product(
            formats.split(",") if formats else FORMATS[protocol],
            [_number(baud, "9600,19200") for baud in bauds.split(",")] if bauds else BAUDS,
        )
    ]
    if isinstance(where, TcpAddress):
        serial = [None]

    async def open_it(settings: SerialSettings | None, ear: Receiver) -> Port:
        return await open_port(where, settings or SerialSettings(), ear)

    return Plan(open_it, protocol, numbers, serial, parsers.duration(timeout))


def _numbers(text: str) -> Iterator[int]:
    """`1-31,40`."""
    for part in text.split(","):
        begin, dash, end = part.partition("-")
        first, last = _number(begin), _number(end if dash else begin)
        if first > last:
            raise ConfigError(f"there is no station between {first} and {last}")
        yield from range(first, last + 1)


def _number(text: str, such_as: str = "1-31,40") -> int:
    if not text.strip().isdecimal() or len(text) > 9:
        raise ConfigError(f"{text!r} is no number: write numbers such as {such_as}")
    return int(text)


async def scan(plan: Plan, tell: Callable[[str], None] = lambda _: None) -> Report:
    """Ask every station something harmless, at one speed and format after the other.

    Ends with the first speed and format at which anybody answers: a wire has one. Raises
    `LineDown` when the port cannot be opened, or goes.
    """
    report = Report()
    for settings in plan.serial:
        tell(f"asking {len(plan.stations)} stations at {spoken(settings)}")
        await _Wire(plan, settings, report).ask()
        if report.found:
            break
    return report


def spoken(settings: SerialSettings | None) -> str:
    """`19200 7E1`."""
    return "the port" if settings is None else f"{settings.baudrate} {settings.format}"


class _Wire:
    """The port as it is opened once. The `Receiver` of whatever question is open."""

    def __init__(self, plan: Plan, serial: SerialSettings | None, report: Report) -> None:
        self._plan = plan
        self._serial = serial
        self._report = report
        behind = serial or SerialSettings()  # there may be a slow wire behind a network
        self._wire = WireTiming(behind.baudrate, character_bits(behind.format))
        self._clock = Clock(now=asyncio.get_running_loop().time)
        self._turn: Turn | None = None
        self._lost: LineDown | None = None

    def received(self, data: bytes) -> None:
        if self._turn is not None:
            self._turn.received(data)

    def lost(self, error: Exception) -> None:
        self._lost = error if isinstance(error, LineDown) else LineDown(str(error))
        if self._turn is not None:
            self._turn.lost(self._lost)

    async def ask(self) -> None:
        port = await self._plan.open_port(self._serial, self)
        try:
            for salt, station in enumerate(self._plan.stations):
                if (found := await self._seek(port, station, salt)) is not None:
                    self._report.found.append(found)
        finally:
            await port.close()

    async def _seek(self, port: Port, station: int, salt: int) -> Found | None:
        """A "no" shows that it is there, but perhaps not spoken to as it should be."""
        refused: Found | None = None
        for driver, settings in ways(self._plan.protocol, station):
            try:
                if await self._answers(port, driver, salt):
                    return Found(self._serial, driver, settings)
            except Refused as error:
                refused = refused or Found(self._serial, driver, settings, str(error))
        return refused

    async def _answers(self, port: Port, driver: AnyDriver, salt: int) -> bool:
        """Raises `Refused` and `LineDown`."""
        if self._lost is not None:
            raise self._lost
        turn = self._turn = Turn(
            port,
            driver.codec,
            self._wire,
            self._wire.silence(driver.timing),
            self._plan.timeout,
            self._clock,
            Recorder("scan"),
            driver.station,
        )
        try:
            await driver.resync(turn, None, salt)
        except Unclear as error:
            if isinstance(error, Garbled):
                self._report.noises.setdefault(self._serial, str(error))
                await turn.settle(LONGEST_NOISE, QUIET)
            return False
        finally:
            self._turn = None
        return True
