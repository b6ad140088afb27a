"""The configuration as a text that a command replaces: checked first, and at once."""

import shutil
from collections.abc import Callable
from pathlib import Path

from gateway import files
from gateway.errors import ConfigError

BOM = b"\xef\xbb\xbf"


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
    after: str,
    check: Callable[[str], object],
    *,
    backup: bool = True,
    dry: bool = False,
) -> list[str]:
    """Replaces the text of a file at once, after `check` of the new one, which raises
    `ConfigError`, and only if it is still as `before`. Returns a sentence about the backup, if
    there is one. `dry`: only checks."""
    check(after)
    if dry:
        return []
    into = into.resolve()  # the file itself, not a link to it
    try:
        if into.read_bytes() != before:
            raise ConfigError(f"{into.name} was changed meanwhile: import again")
        if backup:
            shutil.copy2(into, backup_of(into))
        start = before[: len(before) - len(before.removeprefix(BOM))]
        files.put(into, start + after.encode(), into.stat().st_mode)
    except OSError as error:
        raise ConfigError(f"{into} cannot be written: {error.strerror}") from None
    return [f"the file before is {backup_of(into).name}"] if backup else []


def backup_of(into: Path) -> Path:
    return into.with_name(f"{into.name}.bak")
