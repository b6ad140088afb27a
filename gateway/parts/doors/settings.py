"""The section `share` of the file: the doors of lines for other programs."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path as FilePath
from typing import Annotated

from gateway.config.messages import Mistakes, meant, one_of, shown
from gateway.config.port_rules import SHOWS_ONE
from gateway.config.settings import parsers
from gateway.config.settings.model import LineTlsSection
from gateway.config.settings.records import Config, LineConfig
from gateway.config.settings.sections import PartSection, Place
from gateway.config.settings.session_model import Section
from gateway.config.settings.setting_types import (
    NETWORKS_SCHEMA,
    Interval,
    Parsed,
    Text,
)
from gateway.config.settings.zenoh_records import tls_files
from gateway.engine.device.device_settings import DeviceSettings
from gateway.errors import ConfigError
from gateway.protocols.driver import Span
from gateway.protocols.ranges import addresses
from gateway.stations.served.registry import relatives
from gateway.transport.port import (
    ModemAddress,
    Networks,
    SerialPath,
    TcpAddress,
    TlsConfig,
    UdpAddress,
    is_loopback,
    named,
)

_PERCENT = re.compile(r"([1-9][0-9]?) ?%\Z")
_LISTEN_SCHEMA = {"type": "string", "pattern": r"^(/.+|\[?[^\[\]/\s]+\]?:[0-9]{1,5})$"}
_MOST_WRITTEN = 65_536  # addresses of one range
RAW, RFC2217 = "raw", "rfc2217"
ALONE = (RAW, RFC2217)  # the program has the wire alone
LONGEST_WAIT = 10.0  # seconds
USUAL_SHARE = 0.3  # of the wire time


def _listens(value: object) -> TcpAddress | SerialPath:
    if isinstance(value, str) and value.startswith("/"):
        return SerialPath(value)
    return TcpAddress(*parsers.web_address(value))


def _percent(value: object) -> float:
    if not (match := _PERCENT.match(value if isinstance(value, str) else "")):
        raise ConfigError(f"{shown(value)} is no share of a line: write 1% to 99%")
    return int(match[1]) / 100


class DoorSection(Section):
    """One door: programs that connect to it ask the devices of a line."""

    line: Text
    """The name of the line."""
    listen: Annotated[TcpAddress | SerialPath, Parsed(_listens, _LISTEN_SCHEMA)]
    """The address of the door, such as 127.0.0.1:1502; or the path of a pseudo terminal, such as
    /run/plc-gateway/hall-1."""
    protocol: Text
    """The frames that the programs send: modbus-tcp, modbus-rtu, modbus-ascii, vigor,
    computer-link. raw: the program has the wire alone. rfc2217: as raw, and it sets baud rate and
    parity."""
    allow: Annotated[Networks | None, Parsed(parsers.networks, NETWORKS_SCHEMA)] = None
    """The addresses that may connect, such as [10.1.0.0/16]."""
    tls: LineTlsSection | None = None
    """The certificates of the door: programs connect by TLS."""
    writes: dict[str, list[Text]] = {}
    """By device: the addresses that may be written, such as {press: [D0..D99]}; left out: none."""
    most: Annotated[
        float | None, Parsed(_percent, {"type": "string", "pattern": "^[1-9][0-9]? ?%$"})
    ] = None
    """The share of the wire time that the programs get; left out: 30%."""
    reply_within: Interval = 1.0
    """Requests that wait longer get no reply: the program no longer waits for one."""
    max_age: Interval | None = None
    """Reads of polled addresses get values of the last poll if they are no older; left out: each
    is sent to the device."""
    idle: Interval = 60.0
    """With raw and rfc2217: a program that sends nothing for so long loses the wire."""


class ShareSection(Section):
    """Doors of lines for other programs: docs/share.md."""

    doors: dict[str, DoorSection]
    """The doors, by name."""


@dataclass(frozen=True, slots=True)
class Door:
    """One checked door. Times in seconds, `most` a share of 1."""

    name: str
    line: str
    where: TcpAddress | SerialPath
    protocol: str
    networks: Networks
    writes: Mapping[str, tuple[Span, ...]]  # by device
    most: float
    reply_within: float
    idle: float
    max_age: float = 0.0  # seconds; 0: no value of a poll is an answer

    @property
    def listens(self) -> str:
        """The address or the path, as in the file."""
        where = self.where
        return where.path if isinstance(where, SerialPath) else named(where.host, where.port)

    @property
    def tls(self) -> TlsConfig | None:
        """The certificates; None: it is open to read on the way."""
        return self.where.tls if isinstance(self.where, TcpAddress) else None

    def stations(self, config: Config) -> dict[int, DeviceSettings]:
        """Returns the devices behind the door, by station number."""
        (line,) = (one for one in config.lines if one.name == self.line)
        return {one.driver.station: one for one in _spoken(line, self.protocol) if one.enabled}

    def may_write(self, device: str, area: str, number: int) -> bool:
        return any(
            span.area == area and span.start <= number < span.start + span.size
            for span in self.writes.get(device, ())
        )


@dataclass(frozen=True, slots=True)
class Sharing:
    """All doors of the file."""

    doors: tuple[Door, ...]

    def secured(self) -> Mapping[str, TlsConfig | None]:
        """The certificates, by setting."""
        return {f"share.doors.{one.name}.tls": one.tls for one in self.doors}


def _place(settings: ShareSection | None, place: Place) -> Sharing | None:
    if settings is None:
        return None
    found, ports = list[Door](), dict[TcpAddress | SerialPath, str]()
    for name, section in settings.doors.items():
        own = place.mistakes.at("share", "doors", name)
        other = ports.setdefault(section.listen, name)
        if other != name:
            own.add(f"door {other} listens there already", "listen")
        if (door := _door(name, section, own, place)) is not None:
            found.append(door)
    return Sharing(tuple(found))


def _door(name: str, section: DoorSection, mistakes: Mistakes, place: Place) -> Door | None:
    lines = {line.name: line for line in place.lines}
    if wrong := _why_not_reached(section):
        mistakes.add(wrong, "allow")
    if section.reply_within > LONGEST_WAIT:
        mistakes.add(f"at most {LONGEST_WAIT:g}s: no program waits longer", "reply_within")
    line = lines.get(section.line)
    if line is None:
        mistakes.add(f"there is no line {section.line}: {meant(section.line, lines)}", "line")
        return None
    if why := _why_not(line, raw=section.protocol in ALONE):
        mistakes.add(f"{line.name} {why}", "line")
        return None
    devices = {one.name: one for one in _spoken(line, section.protocol)}
    if section.protocol in ALONE and section.writes:
        text = (
            f"a door with {section.protocol} passes on all that the program sends: remove `writes`"
        )
        mistakes.add(text, "writes")
        return None
    if section.protocol == RFC2217 and isinstance(section.listen, SerialPath):
        text = "a terminal has its own settings, which are followed with `raw`"
        mistakes.add(text, "protocol")
        return None
    if not devices and section.protocol not in ALONE:
        known = sorted({name for one in line.devices for name in relatives(one.driver.protocol)})
        text = f"its devices can be asked by {one_of(known)}" if known else "none can be asked"
        mistakes.add(f"no device of {line.name} for {section.protocol}: {text}", "protocol")
        return None
    return Door(
        name,
        line.name,
        _secured_port(section, mistakes.at("tls"), place.folder),
        section.protocol,
        section.allow or (),
        _writes(section, devices, mistakes.at("writes")),
        USUAL_SHARE if section.most is None else section.most,
        section.reply_within,
        section.idle,
        section.max_age or 0.0,
    )


def _secured_port(
    section: DoorSection, mistakes: Mistakes, folder: FilePath
) -> TcpAddress | SerialPath:
    """Returns the address with its certificates."""
    where, own = section.listen, section.tls
    if own is None:
        return where
    if isinstance(where, SerialPath):
        mistakes.add("a terminal has no TLS: remove `tls`")
        return where
    if own.certificate is None:
        mistakes.add(SHOWS_ONE)
    if own.writers and not own.mutual:
        text = "roles are in the certificates of programs: they need `mutual: true`"
        mistakes.add(text, "writers")
    if own.name:
        mistakes.add("programs have roles: `writers`", "name")
    return replace(where, tls=tls_files(own.record(), folder, mistakes))


def _why_not_reached(section: DoorSection) -> str:
    where = section.listen
    if isinstance(where, SerialPath):
        text = "a terminal has no addresses: remove `allow`; those in the group dialout may open it"
        return text if section.allow is not None else ""
    if section.allow is not None or is_loopback(where.host):
        return ""
    text = f"other machines can reach {where.host}: write the networks that may connect, such as "
    return f"{text}[10.1.0.0/16], or listen on 127.0.0.1:{where.port}"


def _writes(
    section: DoorSection, devices: Mapping[str, DeviceSettings], mistakes: Mistakes
) -> Mapping[str, tuple[Span, ...]]:
    found = dict[str, tuple[Span, ...]]()
    for name, texts in section.writes.items():
        if name not in devices:
            text = f"the door has no device {name}: {meant(name, devices)}"
            mistakes.add(text, name)
            continue
        spans = list[Span]()
        for number, text in enumerate(texts):
            try:
                area, numbers = addresses(devices[name].driver, text, _MOST_WRITTEN)
                spans.append(Span(area, numbers.start, len(numbers)))
            except ConfigError as error:
                mistakes.add(str(error), name, number)
        found[name] = tuple(spans)
    return found


def _why_not(line: LineConfig, *, raw: bool) -> str:
    if line.serve:
        return "has `serve: true`: another master owns its wire"
    if line.listen_only:
        return "only listens: it never sends a request"
    if isinstance(line.port, UdpAddress):
        return "has a port udp://: its device takes datagrams of several programs itself"
    if isinstance(line.port, ModemAddress):
        return "has a modem: each request of a program would dial"
    if raw and line.close_after:
        return "has `close_after`: its port is not there between two rounds"
    return ""


def _spoken(line: LineConfig, protocol: str) -> list[DeviceSettings]:
    """Returns the devices that can be asked in the frames of this protocol."""
    numbered = [one for one in line.devices if one.driver.traits.numbered]
    return [one for one in numbered if protocol in relatives(one.driver.protocol)]


SECTION = PartSection(name="share", settings=ShareSection, place=_place)
