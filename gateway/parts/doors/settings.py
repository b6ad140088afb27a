"""The section `share` of the file: the doors of lines for other programs."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from gateway.config.messages import Path, meant, one_of, shown
from gateway.config.settings import parsers
from gateway.config.settings.records import Config, LineConfig
from gateway.config.settings.sections import PartSection, Place
from gateway.config.settings.session_model import Section
from gateway.config.settings.setting_types import (
    NETWORKS_SCHEMA,
    Interval,
    Parsed,
    Text,
    WebAddress,
)
from gateway.engine.device.device_settings import DeviceSettings
from gateway.errors import ConfigError
from gateway.protocols.driver import Span
from gateway.protocols.ranges import addresses
from gateway.stations.served.registry import relatives
from gateway.transport.port import ModemAddress, Networks, TcpAddress, is_loopback

_PERCENT = re.compile(r"([1-9][0-9]?) ?%\Z")
_MOST_WRITTEN = 65_536  # addresses of one range
RAW = "raw"
LONGEST_WAIT = 10.0  # seconds
USUAL_SHARE = 0.3  # of the wire time


def _percent(value: object) -> float:
    if not (match := _PERCENT.match(value if isinstance(value, str) else "")):
        raise ConfigError(f"{shown(value)} is no share of a line: write 1% to 99%")
    return int(match[1]) / 100


class DoorSection(Section):
    """One door: programs that connect to it ask the devices of a line."""

    line: Text
    """The name of the line."""
    listen: WebAddress
    """The address of the door, such as 127.0.0.1:1502."""
    protocol: Text
    """The frames that the programs send: modbus-tcp, modbus-rtu, modbus-ascii, vigor,
    computer-link. raw: the program has the wire alone."""
    allow: Annotated[Networks | None, Parsed(parsers.networks, NETWORKS_SCHEMA)] = None
    """The addresses that may connect, such as [10.1.0.0/16]."""
    writes: dict[str, list[Text]] = {}
    """By device: the addresses that may be written, such as {press: [D0..D99]}; left out: none."""
    most: Annotated[
        float | None, Parsed(_percent, {"type": "string", "pattern": "^[1-9][0-9]? ?%$"})
    ] = None
    """The share of the wire time that the programs get; left out: 30%."""
    reply_within: Interval = 1.0
    """Requests that wait longer get no reply: the program no longer waits for one."""
    idle: Interval = 60.0
    """With raw: a program that sends nothing for so long loses the wire."""


class ShareSection(Section):
    """Doors of lines for other programs: docs/share.md."""

    doors: dict[str, DoorSection]
    """The doors, by name."""


@dataclass(frozen=True, slots=True)
class Door:
    """One checked door. `reply_within` and `idle` in seconds, `most` a share of 1."""

    name: str
    line: str
    where: TcpAddress
    protocol: str
    networks: Networks
    writes: Mapping[str, tuple[Span, ...]]  # by device
    most: float
    reply_within: float
    idle: float

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


def _place(settings: ShareSection | None, place: Place) -> Sharing | None:
    if settings is None:
        return None
    found, ports = list[Door](), dict[tuple[str, int], str]()
    for name, section in settings.doors.items():
        path: Path = ("share", "doors", name)
        other = ports.setdefault(section.listen, name)
        if other != name:
            place.mistakes.add((*path, "listen"), f"door {other} listens there already")
        if (door := _door(name, section, path, place)) is not None:
            found.append(door)
    return Sharing(tuple(found))


def _door(name: str, section: DoorSection, path: Path, place: Place) -> Door | None:
    mistakes, lines = place.mistakes, {line.name: line for line in place.lines}
    host, port = section.listen
    if section.allow is None and not is_loopback(host):
        text = f"other machines can reach {host}: write the networks that may connect, such as "
        mistakes.add((*path, "allow"), f"{text}[10.1.0.0/16], or listen on 127.0.0.1:{port}")
    if section.reply_within > LONGEST_WAIT:
        mistakes.add((*path, "reply_within"), f"at most {LONGEST_WAIT:g}s: no program waits longer")
    line = lines.get(section.line)
    if line is None:
        mistakes.add(
            (*path, "line"), f"there is no line {section.line}: {meant(section.line, lines)}"
        )
        return None
    if why := _why_not(line, raw=section.protocol == RAW):
        mistakes.add((*path, "line"), f"{line.name} {why}")
        return None
    devices = {one.name: one for one in _spoken(line, section.protocol)}
    if section.protocol == RAW and section.writes:
        text = "a raw door passes on all that the program sends: remove `writes`"
        mistakes.add((*path, "writes"), text)
        return None
    if not devices and section.protocol != RAW:
        known = sorted({name for one in line.devices for name in relatives(one.driver.protocol)})
        text = f"its devices can be asked by {one_of(known)}" if known else "none can be asked"
        mistakes.add(
            (*path, "protocol"), f"no device of {line.name} for {section.protocol}: {text}"
        )
        return None
    return Door(
        name,
        line.name,
        TcpAddress(host, port),
        section.protocol,
        section.allow or (),
        _writes(section, devices, path, place),
        USUAL_SHARE if section.most is None else section.most,
        section.reply_within,
        section.idle,
    )


def _writes(
    section: DoorSection, devices: Mapping[str, DeviceSettings], path: Path, place: Place
) -> Mapping[str, tuple[Span, ...]]:
    found = dict[str, tuple[Span, ...]]()
    for name, texts in section.writes.items():
        if name not in devices:
            text = f"the door has no device {name}: {meant(name, devices)}"
            place.mistakes.add((*path, "writes", name), text)
            continue
        spans = list[Span]()
        for number, text in enumerate(texts):
            try:
                area, numbers = addresses(devices[name].driver, text, _MOST_WRITTEN)
                spans.append(Span(area, numbers.start, len(numbers)))
            except ConfigError as error:
                place.mistakes.add((*path, "writes", name, number), str(error))
        found[name] = tuple(spans)
    return found


def _why_not(line: LineConfig, *, raw: bool) -> str:
    if line.serve:
        return "has `serve: true`: another master owns its wire"
    if line.listen_only:
        return "only listens: it never sends a request"
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
