"""The line of a recording: from the configuration, or from the protocol alone."""

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from gateway.cli.line.peek import given_settings
from gateway.cli.progress import loaded
from gateway.cli.trace import line_named
from gateway.config import LineConfig, built
from gateway.config.settings.validate import driver_settings
from gateway.config.yaml.scalars import scalar
from gateway.errors import ConfigError, GatewayError
from gateway.parts.recording.replay import of_units, stations_asked, timed
from gateway.parts.recording.wire_file import LoggedPiece, LoggedValue, entries
from gateway.protocols.driver import AnyDriver
from gateway.protocols.listening import Listenable
from gateway.protocols.registry import PROTOCOLS

_NOTE = re.compile(r"# (line|protocol|wire) (\S.*)$")
_NOTED = 20  # lines at the begin of a file


class Log:
    """The files of a recording. Raises `ConfigError` for a file that is not there."""

    def __init__(self, paths: Sequence[Path], line: str | None) -> None:
        """`line`: the pieces of other lines are skipped."""
        self._files: list[Path] = []
        self._line = line
        for path in paths:
            self._files += sorted(path.glob("*.log")) if path.is_dir() else [path]
        if missing := [str(file) for file in self._files if not file.is_file()]:
            raise ConfigError(f"there is no file {', '.join(missing)}")
        if not self._files:
            raise ConfigError(f"no file *.log in {', '.join(map(str, paths))}")

    def entries(self) -> Iterator[LoggedPiece | LoggedValue]:
        for file in self._files:
            with file.open(encoding="utf-8", errors="replace") as log:
                yield from entries(log, self._line)

    def line(self) -> str:
        """Returns the line of the notes `# line hall-1`. Raises `ConfigError` for several."""
        names = self._noted("line") if self._line is None else [self._line]
        if len(names) != 1:
            raise ConfigError(
                f"name the line with --line: {', '.join(sorted(names)) or 'not noted'}"
            )
        return names[0]

    def protocols(self) -> list[str]:
        """Returns those of the notes `# protocol vigor`."""
        return self._noted("protocol")

    def wire(self) -> dict[str, object]:
        """Returns `baudrate` and `format` of the note `# wire 19200 7E1`, if there is one."""
        match " ".join(self._noted("wire")[:1]).split():
            case [baudrate, form]:
                return {"baudrate": scalar(baudrate), "format": form}
        return {}

    def _noted(self, what: str) -> list[str]:
        found: dict[str, None] = {}
        for file in self._files:
            with file.open(encoding="utf-8", errors="replace") as log:
                for _, text in zip(range(_NOTED), log, strict=False):
                    match = _NOTE.match(text.rstrip())
                    if match is not None and match[1] == what:
                        found[match[2]] = None
        return list(found)


def line_of_file(config: Path, log: Log) -> LineConfig:
    """Returns the line of the recording as the file describes it. Raises `ConfigError`."""
    return line_named(loaded(config), log.line())


def line_of_protocols(log: Log, protocols: Sequence[str], settings: Sequence[str]) -> LineConfig:
    """Returns a line of the stations that the recording names, with a tag for each unit.

    `settings`: of its devices, each `name=value`. Raises `GatewayError` where nothing is found.
    """
    protocols = protocols or log.protocols()
    if not protocols:
        raise ConfigError("the recording names no protocol: name it with --protocol, or --config")
    given = given_settings(settings, "frame_format=4")
    wire = log.wire()
    pieces = list(timed(log.entries()))
    devices: dict[str, Mapping[str, object]] = {}
    for one in protocols:
        known = driver_settings(one) if one in PROTOCOLS and len(protocols) > 1 else given
        own = {"protocol": one} | {name: given[name] for name in given if name in known}
        line = _built({"device": own | {"station": 1}}, {})
        wire = wire or _usual(line)
        character = line.wire.character
        asked = [piece for piece in pieces if len(protocols) == 1 or piece.way == ">"]
        for station in stations_asked(_listenable(line.devices[0].driver), asked, character):
            name = f"station-{station}" if len(protocols) == 1 else f"{one}-{station}"
            devices[name] = own | {"station": station}
    if not devices:
        raise GatewayError(
            f"the recording has no request of {' or '.join(protocols)}: is it another protocol, or "
            "does --set lack a setting of the devices?"
        )
    return of_units(_built(devices, wire), pieces)


def _built(devices: Mapping[str, object], wire: Mapping[str, object]) -> LineConfig:
    line = {"port": "simulator", **wire, "devices": devices}
    return built({"lines": {"recording": line}}).lines[0]


def _usual(line: LineConfig) -> dict[str, object]:
    """Returns speed and format of the first protocol; nothing for one without a wire."""
    if line.devices[0].driver.traits.over_network:
        return {}
    return {"baudrate": line.serial.baudrate, "format": line.serial.format}


def _listenable(driver: AnyDriver) -> Listenable:
    if not isinstance(driver, Listenable):
        raise ConfigError(f"{driver.protocol} cannot be replayed")
    return driver
