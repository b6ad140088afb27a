"""The `import` of a PLC's communication table as transfers, or as a served line."""

from collections.abc import Sequence
from pathlib import Path

from gateway.cli.sheets.text_file import BOM, read_file, replace
from gateway.cli.terminal import err
from gateway.config import ConfigErrors, built, load
from gateway.config.loading import dumped
from gateway.config.messages import one_of
from gateway.config.sheets import link_table, read_grid
from gateway.config.sheets.link_table import Transferred
from gateway.config.sheets.tags import native
from gateway.config.yaml.file import read_yaml
from gateway.config.yaml.insert import flow
from gateway.errors import ConfigError

EVERY = "1s"  # the instruction of the PLC copies again and again


def import_transfers(sheet: Path, into: Path | None, master: str, *, dry_run: bool = False) -> None:
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
    kept = replace(into, before, after, lambda text: _check(into, text), dry=dry_run)
    for line in (f"{into.name}: {len(found)} transfers of {sheet.name} added", *kept):
        print(line)


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


def _check(into: Path, text: str) -> None:
    try:
        load(into, text=text)
    except ConfigErrors as error:
        raise ConfigErrors([*error.messages, "nothing was written"], error.count) from None
