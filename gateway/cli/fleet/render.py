"""The `fleet PREFIX render` command: one file for each row of a table, from one template."""

from collections.abc import Iterator
from pathlib import Path
from string import Template
from typing import Annotated

import typer

from gateway import files
from gateway.cli.fleet.place import Place
from gateway.cli.sheets.text_file import BOM, read_file
from gateway.config import load
from gateway.config.sheets import read_grid
from gateway.errors import ConfigError

_MODE = 0o644  # secrets are in files of their own
_MOST_SHOWN = 20  # mistakes


def render(
    ctx: typer.Context,
    template: Annotated[Path, typer.Argument(help="A gateway's file with ${column} in it.")],
    table: Annotated[Path, typer.Argument(help="A row for each gateway: CSV, .xlsx, .ods ...")],
    folder: Annotated[Path, typer.Argument(help="Where the files go, each with its name.")],
) -> None:
    """Write the file of each gateway: a template filled with the rows of a table, all or none."""
    text = read_file(template).removeprefix(BOM).decode("utf-8", "replace")
    place: Place = ctx.obj
    found, mistakes = dict[Path, str](), list[str]()
    for row, values in _rows(table):
        try:
            name, filled = _filled(template, text, values, place)
            if (file := folder / f"{name}.yaml") in found:
                raise ConfigError(f"a row above makes {file} too: each gateway has its own name")
            found[file] = filled
        except KeyError as error:
            raise ConfigError(f"{template}: ${{{error.args[0]}}} is no column of {table}") from None
        except ValueError as error:  # a `$` alone, and all mistakes of a file
            mistakes += [f"{table}:{row}: {one}" for one in str(error).splitlines()]
    if mistakes or not found:
        shown = mistakes[:_MOST_SHOWN] or [f"{table} has no row below its titles"]
        raise ConfigError("\n".join([*shown, "nothing was written"]))
    changed = [file for file, filled in found.items() if _put(file, filled)]
    print(f"{len(changed)} files written, {len(found) - len(changed)} were so already")
    for other in sorted({*folder.glob("*.yaml")} - found.keys()):
        print(f"{other} is of no row of {table}")


def _filled(template: Path, text: str, values: dict[str, str], place: Place) -> tuple[str, str]:
    """Returns the name of the gateway, and its file. Raises `KeyError`, `ValueError`."""
    filled = Template(text).substitute(values)
    config = load(template, text=filled, elsewhere=True)
    if not place.has(gateway := f"{config.zenoh.prefix}/{config.name}"):
        raise ConfigError(f"{gateway} is not under {place.prefix}")
    return config.name, filled


def _put(file: Path, text: str) -> bool:
    """Returns False where the file is so already. Raises `ConfigError`."""
    try:
        if file.exists() and files.read(file) == text.encode():
            return False
        file.parent.mkdir(exist_ok=True)
        files.put(file, text.encode(), _MODE)
    except OSError as error:
        raise ConfigError(f"{error.filename or file}: {error.strerror}") from None
    return True


def _rows(table: Path) -> Iterator[tuple[int, dict[str, str]]]:
    """Yields each row with its number, by the titles of the first. Raises `ConfigError`."""
    rows = read_grid(read_file(table)).rows
    titles = [cell.strip() for cell in rows[0].cells] if rows else []
    for row in rows[1:]:
        cells = [cell.strip() for cell in row.cells]
        if strange := next((cell for cell in cells if not cell.isprintable()), None):
            raise ConfigError(f"{table}:{row.number}: {strange!r} is not one line of text")
        if any(cells):
            yield (
                row.number,
                {**dict.fromkeys(titles, ""), **dict(zip(titles, cells, strict=False))},
            )
