"""Builds the configuration from the data of the file, and notes every mistake."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from os.path import realpath
from pathlib import Path as FilePath
from typing import Any

from gateway.config.line_rules import check_line, line_wire, modem_of, origin_of
from gateway.config.messages import Mistakes, meant, one_of, shown
from gateway.config.port_rules import check_device_servers, port_of
from gateway.config.settings import parsers
from gateway.config.settings.model import DeviceSection, LineSection
from gateway.config.settings.records import Config, LineConfig
from gateway.config.settings.sections import Place, file_section, placed
from gateway.config.settings.validate import driver_of, driver_settings, protocols, section, unknown
from gateway.config.settings.zenoh_records import existing_file, with_files
from gateway.config.sheets import Grid
from gateway.config.sheets.tags import SheetTags
from gateway.config.tags.computed import check_totals, with_computed
from gateway.config.tags.device_tags import DeviceTags, mapping
from gateway.config.tags.section import TagDefaults, inherit
from gateway.config.tags.served import (
    ServedDevice,
    ServedView,
    check_retained,
    check_served_line,
    check_sources,
    only_served,
    request_gap,
    until_the_next_call,
)
from gateway.config.tags.word_tags import check_overlaps
from gateway.config.transfers.rows import TransferRows
from gateway.engine.device.device_settings import DeviceSettings
from gateway.errors import ConfigError
from gateway.protocols.capabilities import Identifies
from gateway.protocols.driver import AnyDriver
from gateway.protocols.registry import PROTOCOLS, fault_of
from gateway.tags import Tag
from gateway.tags.tag import READ, NotReal
from gateway.transport.port import (
    ListenAddress,
    ModemAddress,
    SerialPath,
    SimulatorAddress,
    UdpAddress,
)

STATE_FILE = FilePath("state.json")  # where there is a folder for it
AUDIT_FILE = FilePath("audit.jsonl")
WRITERS_STATE = FilePath("writers.json")
_OTHERS = {"protocol", "use"}  # of a device, besides its section and the driver's settings
_TIMES = ("reply_timeout", "turnaround", "silence", "retries")  # a device may have its own


@dataclass(slots=True)
class Builder:
    """Builds one `Config`. Paths in the file are relative to `folder`; those of the files that the
    gateway writes to `state_folder`, if there is one."""

    mistakes: Mistakes
    folder: FilePath
    state_folder: FilePath | None = None
    report: Callable[[float], None] | None = None  # receives the share of the devices that is built
    # one more sheet of a device, which is read already
    imports: Mapping[str, tuple[FilePath, Grid]] = field(default_factory=dict)
    _devices: dict[str, str] = field(default_factory=dict)  # name -> its line
    _count: int = 0  # devices in the file
    _intervals: dict[str, float] = field(default_factory=dict)  # by device: the default
    _tags: DeviceTags = field(init=False)
    _sheets: SheetTags = field(init=False)

    def __post_init__(self) -> None:
        self._tags = DeviceTags()
        self._sheets = SheetTags(self.folder, grids=dict(self.imports.values()))

    def config(self, data: Mapping[str, Any]) -> Config | None:
        """Returns the whole file; None, after mistakes, where no part could be made."""
        top = section(file_section(), data, self.mistakes, "the file")
        raw_lines = data.get("lines")
        defaults = _defaults(data, self.mistakes, TagDefaults())
        lines = []
        self._count = sum(len(mapping(_devices_of(raw))) for _, raw in mapping(raw_lines))
        for name, raw in mapping(raw_lines):
            own = self.mistakes.at("lines", name)
            line = self._line(_name(name, own), raw, own, defaults)
            if line is not None:
                lines.append(line)
        if raw_lines == {}:
            self.mistakes.add("no lines: a gateway has at least one", "lines")
        lines = with_computed(lines, self._tags.computed)
        self._check_ports(lines, raw_lines)
        if top is not None and top.gateway.standby is not None:
            check_totals(lines, self.mistakes)
        check_sources(lines, self.mistakes)
        rows = TransferRows(lines, self._intervals, self.mistakes)
        lines, transfers = rows.build(data.get("transfers"))
        if top is None:
            return None
        state_file = self._kept(top.gateway.state, STATE_FILE)
        check_retained(lines, state_file, top.gateway.standby, self.mistakes)
        place = Place(
            self.mistakes,
            self.folder,
            self.state_folder,
            state_file,
            lines,
            self._tags.recorded or self._sheets.recorded,
            top.writers is not None,
        )
        return Config(
            name=top.gateway.name,
            state_file=state_file,
            audit_file=self._kept(top.gateway.audit, AUDIT_FILE),
            standby=top.gateway.standby,
            standby_alone=top.gateway.standby_alone,
            secret_file=self._file(top.gateway.secret_file, "gateway", "secret_file"),
            writers_file=self._file(top.writers.file, "writers", "file") if top.writers else None,
            folder=self.state_folder or self.folder,
            writers_state=self._written(WRITERS_STATE) if top.writers else None,
            zenoh=with_files(top.zenoh.record(), self.folder, self.mistakes.at("zenoh")),
            parts=placed(top, place),
            lines=tuple(lines),
            transfers=transfers,
            watch=top.gateway.watch_config,
            sheets=tuple(self._sheets.used),
        )

    def _line(
        self, name: str, raw: object, mistakes: Mistakes, outer: TagDefaults
    ) -> LineConfig | None:
        line = section(LineSection, raw, mistakes, "a line")
        if not isinstance(raw, dict):
            return None
        defaults = _defaults(raw, mistakes, outer)
        not_real = None if line is None else origin_of(line, mistakes)
        devices = []
        for device_name, raw_device in mapping(raw.get("devices")):
            own = mistakes.at("devices", device_name)
            checked = _name(device_name, own)
            if checked in self._devices:
                own.add(
                    f"a device {checked} is already on line {self._devices[checked]}: "
                    "a name is used once in the file, it is the key of the values"
                )
            self._devices.setdefault(checked, name)
            serve = line is not None and line.serve
            device = self._device(
                checked, raw_device, own, defaults, serve=serve, not_real=not_real
            )
            if device is not None:
                devices.append(device)
            if self.report is not None:
                self.report(len(self._devices) / self._count)
        if raw.get("devices") == {}:
            mistakes.add("no devices: a line has at least one", "devices")
        if line is None:
            return None
        check_line(line, devices, mistakes)
        if line.serve:
            check_served_line(line, devices, mistakes)
        serial, wire = line_wire(line, devices, mistakes)
        modem = modem_of(line, raw.get("modem"), wire, mistakes)
        if modem is not None and line.serve:
            devices = [until_the_next_call(one, raw) for one in devices]
        return LineConfig(
            name=name,
            port=port_of(line, self.folder, mistakes),
            serial=serial,
            wire=wire,
            echo=line.echo,
            modem=modem,
            connect_delay=line.connect_delay,
            close_after=line.close_after or "",
            listen_only=line.listen_only,
            not_real=not_real,
            serve=line.serve,
            request_gap=request_gap(line, dials=modem is not None),
            devices=tuple(replace(one, listen_only=line.listen_only) for one in devices),
        )

    def _device(
        self,
        name: str,
        raw: object,
        mistakes: Mistakes,
        outer: TagDefaults,
        *,
        serve: bool,
        not_real: NotReal | None,
    ) -> DeviceSettings | None:
        if not isinstance(raw, dict):
            section(DeviceSection, raw, mistakes, "a device")
            return None
        common = {key: value for key, value in raw.items() if key in DeviceSection.model_fields}
        own = {k: v for k, v in raw.items() if k not in common and k not in _OTHERS}
        settings = section(DeviceSection, common, mistakes, "a device")
        driver = _driver(raw.get("protocol"), own, mistakes)
        defaults = _defaults(raw, mistakes, outer)
        addressing = ServedView(driver) if serve and driver is not None else driver
        self._intervals[name] = defaults.every
        own_tags = raw.get("tags"), mistakes.at("tags")
        tags = self._tags.build(name, *own_tags, defaults, addressing, not_real=not_real)
        sheets = len(self._sheets.used)
        own_sheet = None if settings is None else settings.tags_from
        for sheet in filter(None, (own_sheet, self.imports.get(name, (None,))[0])):
            place, taken = mistakes.at("tags_from"), {tag.name for tag in tags}
            tags += self._sheets.build(
                name, sheet, place, defaults, addressing, taken, not_real=not_real
            )
        if settings is None or driver is None:
            return None
        served = None
        if serve:
            rest = [sheet.raw for sheet in self._sheets.used[sheets:]]
            device = ServedDevice(driver, settings, raw, rest, defaults, mistakes)
            served, tags = device.build(tags)
        else:
            only_served(raw, mistakes)
            check_overlaps(driver, tags, mistakes.at("tags"))
        default = driver.timing
        own_times = {name: getattr(settings, name) for name in _TIMES}
        timing = replace(
            default,
            **{name: given for name, given in own_times.items() if given is not None},
            learn_silence=default.learn_silence and settings.silence is None,
        )
        _check_identity(settings.identity or {}, driver, tags, mistakes.at("identity"))
        late_guard = settings.late_guard
        return DeviceSettings(
            name=name,
            driver=driver,
            timing=timing,
            turnaround=settings.turnaround,
            late_guard=timing.reply_timeout if late_guard is None else late_guard,
            verify_reads=settings.verify_reads,
            identity=settings.identity or {},
            blocks=settings.blocks,
            control=settings.control,
            templates=tuple(raw.get("use", ())),
            enabled=settings.enabled,
            tags=tags,
            served=served,
        )

    def _check_ports(self, lines: list[LineConfig], raw_lines: object) -> None:
        ports: dict[object, str] = {}
        check_device_servers({line.name: line.port for line in lines}, self.mistakes)
        for line in lines:
            if isinstance(line.port, SimulatorAddress | ListenAddress):
                continue
            port = line.port.port if isinstance(line.port, ModemAddress) else line.port
            places: list[object]
            match port:
                case SerialPath(path):
                    places = [realpath(path)]
                case UdpAddress():
                    places = [port]
                case _:
                    places = [(port.host, port.port), *port.reach.others]
            others = [ports.setdefault(place, line.name) for place in places]
            if other := next((one for one in others if one != line.name), ""):
                self.mistakes.at("lines", line.name, "port").add(
                    f"line {other} has this port already: one port is one line, "
                    "with all its devices"
                )

    def _file(self, name: FilePath | None, *setting: str) -> FilePath | None:
        return existing_file(name, self.folder, self.mistakes.at(*setting))

    def _written(self, name: FilePath) -> FilePath:
        """Returns the path of a file that the gateway writes."""
        return (self.state_folder or self.folder) / name

    def _kept(self, name: FilePath | None, usual: FilePath) -> FilePath | None:
        """Returns the path of a file that is kept: named in the file, or in the state folder."""
        if name is None and self.state_folder is not None:
            name = usual
        return None if name is None else self._written(name)


def _check_identity(
    names: Collection[str], driver: AnyDriver, tags: Sequence[Tag], mistakes: Mistakes
) -> None:
    if not names:  # as of most devices
        return
    own = driver.identity_names if isinstance(driver, Identifies) else ()
    areas = driver.areas
    read = [tag for tag in tags if replace(tag.origin, not_real=None) == READ and tag.polled]
    known = {tag.name for tag in read if areas[tag.span.area].readable}
    for name in set(names) - known - set(own):
        also = f", or {one_of(sorted(own))}" if own else ""
        mistakes.at(name).add(
            f"a {driver.protocol} device does not tell {name}: name a tag of it that is read, "
            f"such as one with its serial number{also}"
        )


def _driver(protocol: object, own: dict[str, Any], mistakes: Mistakes) -> AnyDriver | None:
    if protocol is None:
        mistakes.add(f"missing: a device needs its protocol: {protocols()}", "protocol")
        return None
    if not isinstance(protocol, str) or protocol not in PROTOCOLS:
        fault = fault_of(str(protocol))
        hint = meant(str(protocol), PROTOCOLS)
        mistakes.add(fault or f"{shown(protocol)} is no protocol: {hint}", "protocol")
        return None
    known = driver_settings(protocol)
    for key in own.keys() - known:
        every = sorted((known | set(DeviceSection.model_fields)) - {"protocol"})
        mistakes.add(unknown(key, f"a {protocol} device", every), key)
    return driver_of(protocol, {k: v for k, v in own.items() if k in known}, mistakes)


def _defaults(raw: Mapping[str, Any], mistakes: Mistakes, outer: TagDefaults) -> TagDefaults:
    found = raw.get("defaults")
    if not isinstance(found, dict):
        return outer
    inner = section(TagDefaults, found, mistakes.at("defaults"), "defaults")
    return outer if inner is None else inherit(outer, inner)


def _name(text: str, mistakes: Mistakes) -> str:
    try:
        return parsers.name(text)
    except ConfigError as error:
        mistakes.add(str(error))
        return text


def _devices_of(raw: object) -> object:
    return raw.get("devices") if isinstance(raw, dict) else None
