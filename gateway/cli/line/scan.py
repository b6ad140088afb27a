"""Looks for the stations on an unknown line: which answer, at which speed, in which format."""

from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

from gateway.config.settings import parsers
from gateway.engine.device.device import Device
from gateway.engine.device.device_settings import DeviceSettings
from gateway.errors import ConfigError, Garbled, LineDown, Refused, Unclear
from gateway.line.channel import Channel, Echo
from gateway.line.transaction import Transaction
from gateway.line.wire_log import WireLog
from gateway.planning.wire_timing import WireTiming, character_bits
from gateway.protocols.capabilities import ScanHints, Scannable
from gateway.protocols.driver import AnyDriver
from gateway.protocols.registry import PROTOCOLS
from gateway.protocols.swapped import SWAPPED, KnownReplies, is_swapped
from gateway.transport import (
    ModemAddress,
    Port,
    Receiver,
    SerialSettings,
    SimulatorAddress,
    TcpAddress,
    open_port,
    parse_port,
)

BAUDS = (9600, 19200, 38400, 115200, 57600, 4800)  # the most likely first
# After a damaged reply: seconds of silence before the next request, and the longest wait for it.
QUIET, LONGEST_NOISE = 0.02, 0.5
Open = Callable[[SerialSettings | None, Receiver], Awaitable[Port]]


@dataclass(frozen=True, slots=True)
class Plan:
    """The stations to ask, and the line settings to try."""

    open_port: Open
    protocol: str
    stations: Sequence[int]
    serial: Sequence[SerialSettings | None]  # None: set in a device server
    timeout: float  # seconds from request to reply, without the characters' own time


@dataclass(frozen=True, slots=True)
class Found:
    """A station that replied. `settings` are those of its protocol in the file; `refusal` is its
    error reply where it gave one to all of them."""

    serial: SerialSettings | None
    driver: AnyDriver
    settings: dict[str, object]
    refusal: str = ""


@dataclass(slots=True)
class Report:
    """The stations in the order found, and the line settings with damaged replies."""

    found: list[Found] = field(default_factory=list)
    noises: dict[SerialSettings | None, str] = field(default_factory=dict)


def variants(protocol: str, station: int) -> Iterator[tuple[AnyDriver, dict[str, object]]]:
    """Yields the drivers that may reach a station, each with its settings in the file.

    Raises `ConfigError` for a station number that the protocol does not have.
    """
    known = PROTOCOLS[protocol]
    for settings in _hints(protocol).variants:
        yield known.driver(known.settings(station=station, **settings)), dict(settings)


def protocols() -> list[str]:
    """Returns those that `scan` knows. Reads the metadata of all packages, which takes long."""
    return [name for name, one in PROTOCOLS.items() if isinstance(one.settings, Scannable)]


def _hints(protocol: str) -> ScanHints:
    """Raises `ConfigError` for a protocol that `scan` cannot use."""
    known = PROTOCOLS.get(protocol)
    if known is None or not isinstance(known.settings, Scannable):
        raise ConfigError(f"scan cannot look for {protocol}: use one of {', '.join(protocols())}")
    return known.settings.scan_hints


def planned(
    port: str,
    protocol: str,
    stations: str | None = None,
    bauds: str | None = None,
    formats: str | None = None,
    timeout: str = "200ms",
) -> Plan:
    """Parses the options of the command. Raises `ConfigError`."""
    where, hints = parse_port(port), _hints(protocol)
    asked = list(hints.stations if stations is None else dict.fromkeys(numbers(stations)))
    drivers = [driver for number in asked for driver, _ in variants(protocol, number)]
    if isinstance(where, SimulatorAddress):
        raise ConfigError("simulated PLCs need no scan: the file lists them")
    if isinstance(where, ModemAddress):
        raise ConfigError("scan cannot dial: connect the line by a cable")
    if drivers[0].traits.over_network and not isinstance(where, TcpAddress):
        raise ConfigError(f"{protocol} needs a port tcp://host:port")
    serial: list[SerialSettings | None] = [
        SerialSettings(parsers.baudrate(baud), parsers.serial_format(form))
        for form, baud in product(
            formats.split(",") if formats else hints.formats,
            [_number(baud, "9600,19200") for baud in bauds.split(",")] if bauds else BAUDS,
        )
    ]
    if isinstance(where, TcpAddress):
        serial = [None]

    async def open_it(settings: SerialSettings | None, receiver: Receiver) -> Port:
        return await open_port(where, settings or SerialSettings(), receiver)

    return Plan(open_it, protocol, asked, serial, parsers.duration(timeout))


def numbers(text: str) -> Iterator[int]:
    """Parses `1-31,40`."""
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


async def scan(
    plan: Plan,
    tell: Callable[[str], None] = lambda _: None,
    share: Callable[[str, float], None] = lambda _what, _share: None,
    report: Report | None = None,
) -> Report:
    """Sends a harmless request to every station, at one speed and format after the other.

    Ends with the first speed and format at which a station replies: a line has only one. `share`
    receives the station that is asked, and the share of all that is done. `report` has what replied
    also if the scan is cancelled, or the port is lost. Raises `LineDown` when the port cannot be
    opened, or is lost.
    """
    report = report or Report()
    for number, settings in enumerate(plan.serial):
        tell(f"asking {len(plan.stations)} stations at {spoken(settings)}")

        def step(asked: int, number: int = number, at: str = spoken(settings)) -> None:
            done = (number + asked / len(plan.stations)) / len(plan.serial)
            share(f"station {plan.stations[asked]} at {at}", done)

        await _Scan(plan, settings, report, step).ask()
        if report.found:
            break
    return report


def spoken(settings: SerialSettings | None) -> str:
    """`19200 7E1`."""
    return "the port" if settings is None else f"{settings.baudrate} {settings.format}"


class _Scan:
    """The port, opened once. The `Receiver` of the current transaction."""

    def __init__(
        self,
        plan: Plan,
        serial: SerialSettings | None,
        report: Report,
        step: Callable[[int], None],
    ) -> None:
        self._plan = plan
        self._step = step
        self._serial = serial
        self._report = report
        behind = serial or SerialSettings()  # there may be a slow wire behind a network
        self._wire = WireTiming(behind.baudrate, character_bits(behind.format))
        self._transaction: Transaction | None = None
        self._lost: LineDown | None = None

    def received(self, data: bytes) -> None:
        if self._transaction is not None:
            self._transaction.received(data)

    def lost(self, error: Exception) -> None:
        self._lost = error if isinstance(error, LineDown) else LineDown(str(error))
        if self._transaction is not None:
            self._transaction.lost(self._lost)

    async def ask(self) -> None:
        port = await self._plan.open_port(self._serial, self)
        channel = Channel(port, self._wire, WireLog(), echo=Echo("scan", None))
        try:
            for probe_token, station in enumerate(self._plan.stations):
                self._step(probe_token)
                if (found := await self._seek(channel, station, probe_token)) is not None:
                    self._report.found.append(found)
        finally:
            await channel.close()

    async def _seek(self, channel: Channel, station: int, probe_token: int) -> Found | None:
        """Returns the station. An error reply shows that it exists, perhaps with other settings."""
        refused: Found | None = None
        for driver, settings in variants(self._plan.protocol, station):
            try:
                if await self._replies(channel, driver, probe_token):
                    return self._found(driver, settings)
            except Refused as error:
                refused = refused or self._found(driver, settings, str(error))
        return refused

    def _found(self, driver: AnyDriver, settings: Mapping[str, object], refusal: str = "") -> Found:
        serial, traits = self._serial, driver.traits
        known = dict(settings)
        if serial is not None and traits.one_format and serial.format != traits.format:
            known["format"] = serial.format  # the file must say that this station differs
        return Found(serial, driver, known, refusal)

    async def _replies(self, channel: Channel, driver: AnyDriver, probe_token: int) -> bool:
        """Raises `Refused` and `LineDown`."""
        if self._lost is not None:
            raise self._lost
        timing = replace(driver.timing, reply_timeout=self._plan.timeout)
        settings = DeviceSettings(name=f"station {driver.station}", driver=driver, timing=timing)
        transaction = self._transaction = Transaction(channel, Device(settings, self._wire))
        try:
            await driver.resync(transaction, None, probe_token)
        except Unclear as error:
            if isinstance(error, Garbled):
                swapped = isinstance(driver, KnownReplies) and is_swapped(error.data, driver)
                self._report.noises.setdefault(self._serial, SWAPPED if swapped else str(error))
                await transaction.settle(LONGEST_NOISE, QUIET)
            return False
        finally:
            self._transaction = None
        return True
