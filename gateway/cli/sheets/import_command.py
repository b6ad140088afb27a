"""The `import` command: tags of a sheet into the configuration, all or none."""

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any

import typer

from gateway.cli.terminal import err
from gateway.config import Config, ConfigErrors, SheetUse, built, load
from gateway.config.loading import dumped
from gateway.config.messages import one_of
from gateway.config.sheets import Grid, adapted, cells, devices_in, link_table, read_grid
from gateway.config.sheets.link_table import Transferred
from gateway.config.sheets.tags import native, preview
from gateway.config.yaml.file import read_yaml
from gateway.config.yaml.insert import entry, flow, with_tags
from gateway.errors import ConfigError
from gateway.tags import Tag

SheetPath = Annotated[
    Path,
    typer.Argument(
        metavar="SHEET",
        help="CSV, text, .xlsx, .xls or .ods with titles, or a project of another program.",
    ),
]


def import_(
    sheet: SheetPath,
    into: Annotated[
        Path | None, typer.Option(help="The YAML file that gets the tags; left out: print them")
    ] = None,
    device: Annotated[
        str | None, typer.Option(help="The device in that file (default: its only one)")
    ] = None,
    columns: Annotated[
        list[str] | None,
        typer.Option(metavar="SETTING=TITLE", help="The column of a setting: name=Bezeichnung"),
    ] = None,
    address: Annotated[
        list[str] | None,
        typer.Option(metavar="OLD=NEW", help="How addresses begin there, and here: %MW=holding:"),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Check everything, and write nothing.")
    ] = False,
    transfers: Annotated[
        str | None,
        typer.Option(
            metavar="DEVICE",
            help="The rows of a PLC's communication table become transfers; DEVICE is that PLC.",
        ),
    ] = None,
    serve: Annotated[
        list[int] | None,
        typer.Option(
            metavar="STATION",
            help="Print a served line in the place of this station of a PLC's communication table.",
        ),
    ] = None,
) -> None:
    """Import the tags of a sheet into the configuration. With a mistake nothing is written."""
    if serve:
        if into or device or transfers:
            raise ConfigError("--serve prints a line: leave out --into, --device and --transfers")
        print_served(sheet, serve)
        return
    if transfers is not None:
        import_transfers(sheet, into, transfers)
        return
    grid = adapted(read_grid(read_file(sheet)), _pairs(columns), _pairs(address))
    named = [] if link_table.is_table(grid) else devices_in(grid)
    lines = grid.project.lines if grid.project is not None else {}
    if into is None and lines and not device:
        print(_plant(sheet, grid, lines), end="")
        return
    if into is None:
        tags, notes = preview(sheet, grid, device or (named[0] if len(named) == 1 else ""))
        print_notes(sheet, notes)
        print("tags:", *(f"  {entry(name, raw)}" for name, raw in tags.items()), sep="\n")
        err.print("addresses and limits are not checked yet: name the file with --into")
        return
    if lines and not into.exists():
        text = _plant(sheet, grid, lines)
        if not dry_run:
            write_new(into, text)
        said = [f"{into.name}: {len(grid.rows) - 1} tags of {sheet.name} on {len(lines)} lines"]
    else:
        said = add_tags(sheet, into, [device] if device else named, grid=grid, dry_run=dry_run)
    for line in [*said, "nothing was written: --dry-run"] if dry_run else said:
        print(line)


def _pairs(options: Sequence[str] | None) -> dict[str, str]:
    """Raises `ConfigError`."""
    found = dict(one.partition("=")[::2] for one in options or ())
    if not all(found.values()):
        raise ConfigError("--columns and --address have two sides: name=Bezeichnung, %MW=holding:")
    return found


def _plant(sheet: Path, grid: Grid, lines: Mapping[str, Any]) -> str:
    """Returns a project as a file of its own. Raises `ConfigErrors`."""
    data = {"gateway": {"name": cells.name(sheet.stem)}, "lines": lines}
    devices = {name: one for line in lines.values() for name, one in line["devices"].items()}
    imports = {device: (sheet.absolute(), grid) for device in devices}
    uses = built(data, imports=imports).sheets
    for use in uses:
        devices[use.device]["tags"] = dict(use.raw)
    print_notes(sheet, uses[0].notes)
    return dumped(data)


def add_tags(
    sheet: Path,
    into: Path,
    devices: list[str],
    *,
    backup: bool = True,
    grid: Grid | None = None,
    dry_run: bool = False,
) -> list[str]:
    """Adds the tags of a sheet to the file. Returns sentences about it.

    `backup`: the file as it was stays beside it. `grid`: the sheet, if it was read.

    Raises `ConfigErrors` with every mistake; then the file is as before.
    """
    grid = grid or read_grid(read_file(sheet))
    devices = devices or _devices_of_table(sheet, grid, into) or _only_device(into)
    before = read_file(into)
    try:
        wanted = load(into, imports={device: (sheet.absolute(), grid) for device in devices})
    except ConfigErrors as error:
        ending = "one mistake" if error.count == 1 else f"{error.count} mistakes"
        last = f"{ending}: nothing was written"
        raise ConfigErrors([*error.messages, last], error.count) from None
    uses = [use for use in wanted.sheets if use.file == sheet.absolute()]
    missing = set(devices) - {use.device for use in uses}
    text = before.removeprefix(BOM).decode()
    for use in uses:
        comment = f"{len(use.raw)} tags from {sheet.name}"
        text = with_tags(str(into), text, use.device, use.raw, comment)
    if missing:
        with_tags(str(into), text, missing.pop(), {}, "")  # raises: names the devices of the file
    after = (BOM if before.startswith(BOM) else b"") + text.encode()
    own = into.resolve()  # the file itself, not a link to it

    def check(new: Path) -> None:
        try:
            same = _meaning(load(new)) == _meaning(wanted)
        except ConfigErrors:
            same = False
        if not same:
            raise ConfigError(
                f"the tags cannot be inserted into {own.name} as it is written: "
                "write `tags_from: <sheet>` into the device instead"
            )

    replace(own, before, after, check, backup_of(own) if backup else None, dry_run=dry_run)
    for use in uses:
        print_notes(sheet, use.notes)
    said = [_said(sheet, into, use) for use in uses]
    kept = backup and not dry_run
    return [*said, f"the file before is {backup_of(into).name}"] if kept else said


def _said(sheet: Path, into: Path, use: SheetUse) -> str:
    return f"{into.name}: {len(use.raw)} tags of {sheet.name} added to {use.device}"


def print_notes(sheet: Path, notes: tuple[str, ...] | list[str]) -> None:
    for note in notes:
        err.print(f"note: {sheet.name}: {note}")


def _devices_of_table(sheet: Path, grid: Grid, into: Path) -> list[str]:
    """Returns the devices whose stations a communication table has; none for another sheet."""
    stations = link_table.stations_in(grid)
    devices = load(into).devices if stations else ()
    known = {device.driver.station: device.name for device in devices}
    if missing := [station for station in stations if station not in known]:
        raise ConfigError(
            f"{into.name} has no device with station {one_of(map(str, missing))}, which "
            f"{sheet.name} names: add it, or name one device with --device"
        )
    return [known[station] for station in stations]


def _only_device(into: Path) -> list[str]:
    names = [device.name for device in load(into).devices]
    if len(names) != 1:
        raise ConfigError(f"name the device with --device: {into.name} has {', '.join(names)}")
    return names


def _meaning(config: Config) -> dict[str, tuple[object, ...]]:
    return {tag.key: _settings(tag) for device in config.devices for tag in device.tags}


def _settings(tag: Tag) -> tuple[object, ...]:
    return tuple(getattr(tag, one.name) for one in fields(tag) if one.init)


BOM = b"\xef\xbb\xbf"
EVERY = "1s"  # the instruction of the PLC copies again and again


def import_transfers(sheet: Path, into: Path | None, master: str) -> None:
    """Adds the rows to the file, or prints them. `master`: the device that was the master.

    Raises `ConfigErrors` with every mistake; then the file is as before.
    """
    config = None if into is None else load(into)
    drivers = {} if config is None else {one.driver.station: one.driver for one in config.devices}
    grid = read_grid(read_file(sheet))
    found = link_table.transfers_in(grid, lambda number, text: native(drivers.get(number))(text))
    if not found:
        raise ConfigError(f"{sheet.name} is no communication table: see docs/import.md")
    if into is None or config is None:
        names = {row.station: f"station-{row.station}" for row in found}
        print("transfers:", *_lines(found, names, master), sep="\n")
        err.print("nothing is checked yet: name the file with --into")
        return
    if master not in (known := [device.name for device in config.devices]):
        raise ConfigError(f"there is no device {master} in {into.name}: it has {one_of(known)}")
    names = {device.driver.station: device.name for device in config.devices}
    if missing := [row.station for row in found if row.station not in names]:
        stations = one_of(map(str, dict.fromkeys(missing)))
        raise ConfigError(f"{into.name} has no device with station {stations}: add it")
    before = read_file(into)
    text = before.removeprefix(BOM).decode()
    if "transfers" in read_yaml(into, frozenset())[0].data:
        rows = "\n".join(_lines(found, names, master))
        raise ConfigError(f"{into.name} has `transfers:` already: add these rows to it\n{rows}")
    newline = "\r\n" if "\r\n" in text else "\n"
    comment = f"# {len(found)} rows of {sheet.name}, which {master} copied as the master"
    body = newline.join([comment, "transfers:", *_lines(found, names, master), ""])
    after = f"{text.rstrip()}{newline}{newline}{body}"
    own = into.resolve()  # the file itself, not a link to it
    kept = (BOM if before.startswith(BOM) else b"") + after.encode()
    replace(own, before, kept, lambda new: _check(new, own), backup_of(own))
    print(f"{into.name}: {len(found)} transfers of {sheet.name} added")
    print(f"the file before is {backup_of(into).name}")


def print_served(sheet: Path, stations: Sequence[int]) -> None:
    """Prints a line on which the gateway is these stations, and the PLC stays the master.

    Raises `ConfigErrors` with every mistake; then nothing is printed.
    """
    grid = read_grid(read_file(sheet))
    found = link_table.transfers_in(grid, lambda _, text: text)
    if not found:
        raise ConfigError(f"{sheet.name} is no communication table: see docs/import.md")
    devices = {}
    for station in dict.fromkeys(stations):
        rows = [row.cells for row in link_table.of_station(grid, station).rows[1:]]
        written = [row.slave for row in found if row.station == station and not row.reads]
        devices[f"station-{station}"] = {
            "protocol": "modbus-rtu" if ":" in rows[0][1] else "vigor",
            "station": station,
            "accept": [*dict.fromkeys(written)],
            "tags": {
                name: {"address": address, "description": comment}
                | ({"write": True} if command == "r" else {})
                for name, address, command, comment in rows
            },
        }
    line = {"port": "/dev/ttyUSB0", "serve": True, "devices": devices}
    built(data := {"lines": {"master-plc": line}})
    print(dumped(data), end="")
    err.print("set port, baudrate and format of the master; switch off the stations themselves")


def _lines(found: Sequence[Transferred], names: dict[int, str], master: str) -> list[str]:
    rows = []
    for row in found:
        slave, own = f"{names[row.station]}:{row.slave}", f"{master}:{row.master}"
        source, target = (slave, own) if row.reads else (own, slave)
        rows.append(f"  - {flow({'from': source, 'to': target, 'every': EVERY})}")
    return rows


def _check(new: Path, own: Path) -> None:
    try:
        load(new)
    except ConfigErrors as error:
        messages = [text.replace(str(new), str(own)) for text in error.messages]
        last = "nothing was written"
        raise ConfigErrors([*messages, last], error.count) from None


def read_file(path: Path) -> bytes:
    """Raises `ConfigError`."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}") from None


def write_new(into: Path, text: str) -> None:
    """Writes a file that does not exist. Raises `ConfigError`."""
    try:
        with into.open("x", encoding="utf-8") as stream:
            stream.write(text)
    except OSError as error:
        raise ConfigError(f"{into} cannot be written: {error.strerror}") from None


def replace(
    into: Path,
    before: bytes,
    after: bytes,
    check: Callable[[Path], None],
    backup: Path | None,
    *,
    dry_run: bool = False,
) -> None:
    """Replaces the file at once, after `check` of the new text, which raises `ConfigError`."""
    new = into.with_name(f"{into.name}.new")
    try:
        new.write_bytes(after)
        check(new)
        shutil.copymode(into, new)
        if into.read_bytes() != before:
            raise ConfigError(f"{into.name} was changed meanwhile: import again")
        if dry_run:
            return
        if backup is not None:
            shutil.copy2(into, backup)
        new.replace(into)
    except OSError as error:
        raise ConfigError(f"{into} cannot be written: {error.strerror}") from None
    finally:
        new.unlink(missing_ok=True)


def backup_of(into: Path) -> Path:
    return into.with_name(f"{into.name}.bak")
