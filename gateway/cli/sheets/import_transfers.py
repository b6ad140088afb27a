"""The part of `import` for transfers: the rows of a PLC's communication table into the file."""

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

from gateway.cli.terminal import err
from gateway.config import ConfigErrors, load
from gateway.config.messages import one_of
from gateway.config.sheets import link_table, read_grid
from gateway.config.sheets.link_table import Transferred
from gateway.config.sheets.tags import native
from gateway.config.yaml.file import read_yaml
from gateway.config.yaml.insert import flow
from gateway.errors import ConfigError

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


def replace(
    into: Path, before: bytes, after: bytes, check: Callable[[Path], None], backup: Path | None
) -> None:
    """Replaces the file at once, after `check` of the new text, which raises `ConfigError`."""
    new = into.with_name(f"{into.name}.new")
    try:
        new.write_bytes(after)
        check(new)
        shutil.copymode(into, new)
        if into.read_bytes() != before:
            raise ConfigError(f"{into.name} was changed meanwhile: import again")
        if backup is not None:
            shutil.copy2(into, backup)
        new.replace(into)
    except OSError as error:
        raise ConfigError(f"{into} cannot be written: {error.strerror}") from None
    finally:
        new.unlink(missing_ok=True)


def backup_of(into: Path) -> Path:
    return into.with_name(f"{into.name}.bak")
