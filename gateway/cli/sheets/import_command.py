"""The `import` command: tags of a sheet into the configuration, all or none."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any

import typer

from gateway.cli.progress import busy
from gateway.cli.sheets.communication_table import import_transfers, print_served
from gateway.cli.sheets.text_file import BOM, read_file, replace, write_new
from gateway.cli.terminal import err
from gateway.config import Config, ConfigErrors, built, load
from gateway.config.loading import dumped
from gateway.config.messages import one_of
from gateway.config.sheets import Grid, adapted, cells, devices_in, link_table, read_grid
from gateway.config.sheets.tags import SheetUse, preview
from gateway.config.yaml.insert import entry, with_tags
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
        import_transfers(sheet, into, transfers, dry_run=dry_run)
        if dry_run:
            print(_DRY)
        return
    with busy(f"importing {sheet.name}"):
        said = _import(sheet, into, device, _pairs(columns), _pairs(address), dry_run=dry_run)
    for line in [*said, _DRY] if dry_run and into is not None else said:
        print(line)


_DRY = "nothing was written: --dry-run"


def _import(
    sheet: Path,
    into: Path | None,
    device: str | None,
    columns: Mapping[str, str],
    addresses: Mapping[str, str],
    *,
    dry_run: bool,
) -> list[str]:
    """Imports a sheet. Returns the lines to print."""
    grid = adapted(read_grid(read_file(sheet)), columns, addresses)
    named = [] if link_table.is_table(grid) else devices_in(grid)
    lines = grid.project.lines if grid.project is not None else {}
    if into is None and lines and not device:
        return _plant(sheet, grid, lines).splitlines()
    if into is None:
        tags, notes = preview(sheet, grid, device or (named[0] if len(named) == 1 else ""))
        print_notes(sheet, notes)
        err.print("addresses and limits are not checked yet: name the file with --into")
        return ["tags:", *(f"  {entry(name, raw)}" for name, raw in tags.items())]
    if lines and not into.exists():
        text = _plant(sheet, grid, lines)
        if not dry_run:
            write_new(into, text)
        return [f"{into.name}: {len(grid.rows) - 1} tags of {sheet.name} on {len(lines)} lines"]
    return add_tags(sheet, into, [device] if device else named, grid=grid, dry_run=dry_run)


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
        text, uses = with_sheet(into, before.removeprefix(BOM).decode(), sheet, grid, devices)
    except ConfigErrors as error:
        ending = "one mistake" if error.count == 1 else f"{error.count} mistakes"
        last = f"{ending}: nothing was written"
        raise ConfigErrors([*error.messages, last], error.count) from None
    kept = replace(into, before, text, lambda new: load(into, text=new), backup=backup, dry=dry_run)
    for use in uses:
        print_notes(sheet, use.notes)
    added = f"tags of {sheet.name} added to"
    return [*(f"{into.name}: {len(use.raw)} {added} {use.device}" for use in uses), *kept]


def with_sheet(
    into: Path, text: str, sheet: Path, grid: Grid, devices: Sequence[str]
) -> tuple[str, list[SheetUse]]:
    """Returns the text of the file with the tags of a sheet, and what they are.

    Raises `ConfigErrors` with every mistake.
    """
    imports = {device: (sheet.absolute(), grid) for device in devices}
    wanted = load(into, imports=imports, text=text)
    uses = [use for use in wanted.sheets if use.file == sheet.absolute()]
    missing = set(devices) - {use.device for use in uses}
    for use in uses:
        comment = f"{len(use.raw)} tags from {sheet.name}"
        text = with_tags(str(into), text, use.device, use.raw, comment)
    if missing:
        with_tags(str(into), text, missing.pop(), {}, "")  # raises: names the devices of the file
    try:
        same = _meaning(load(into, text=text)) == _meaning(wanted)
    except ConfigErrors:
        same = False
    if not same:
        raise ConfigError(
            f"the tags cannot be inserted into {into.name} as it is written: "
            "write `tags_from: <sheet>` into the device instead"
        )
    return text, uses


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
    """Returns what the file says of a tag: tags are equal to themselves only."""
    values = {one.name: getattr(tag, one.name) for one in fields(tag) if one.init}
    values["origin"] = dataclasses.replace(tag.origin, inputs=())
    return (*values.values(), *map(_settings, tag.origin.inputs))
