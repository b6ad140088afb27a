"""Files: read without waiting, whatever they are, and never without a limit; written whole."""

import os
import stat
from contextlib import suppress
from errno import EFBIG, EINVAL
from pathlib import Path

MOST = 32 * 2**20  # bytes; a plant of 50,000 tags has 5 MB
MOST_OF_SECRETS = 2**20
LONGEST_NAME, LONGEST_PATH = 255, 4000  # bytes: what file systems take


def read(path: Path, most: int = MOST) -> bytes:
    """Returns the content of a regular file.

    Raises `OSError` for everything else, with a sentence in `strerror`. A pipe without a writer
    would wait for ever; a device may have no end.
    """
    try:
        with open(path, "rb", opener=_without_waiting) as file:
            found = os.fstat(file.fileno())
            if not stat.S_ISREG(found.st_mode):
                raise OSError(EINVAL, "this is no regular file")
            data = b"" if found.st_size > most else file.read(most + 1)
    except ValueError:
        raise OSError(EINVAL, "no file can have this name") from None
    if found.st_size > most or len(data) > most:
        raise OSError(EFBIG, f"it has more than {most // 2**20} MB")
    return data


def append(file: int, data: bytes, *, sync: bool = False) -> None:
    """Appends all of the data to an open file, or nothing: a full disk takes a part.

    `sync`: returns when it is on the disk. Raises `OSError`.
    """
    size, rest = os.fstat(file).st_size, memoryview(data)
    try:
        while rest:
            rest = rest[os.write(file, rest) :]
        if sync:
            os.fsync(file)
    except OSError:
        with suppress(OSError):
            os.ftruncate(file, size)
        raise


def put(path: Path, data: bytes, mode: int = 0o600) -> None:
    """Replaces a file, whole or not at all: on return it is on the disk. Raises `OSError`."""
    new = path.with_name(f"{path.name}.new")
    try:
        new.unlink(missing_ok=True)
        new.touch(0o600, exist_ok=False)
        with new.open("wb") as file:
            os.fchmod(file.fileno(), stat.S_IMODE(mode))
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        new.replace(path)
    finally:
        with suppress(OSError):
            new.unlink(missing_ok=True)
    sync(path.parent)


def sync(path: Path) -> None:
    """Makes a file, or a new name in a folder, survive a power cut."""
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)


def is_file(path: Path) -> bool:
    """Returns True for a regular file. No name of a file raises an error."""
    try:
        return stat.S_ISREG(path.stat().st_mode)
    except (OSError, ValueError):
        return False


def are_same(one: Path, other: Path) -> bool:
    """Returns True for one file, also with two names. Each may be replaced at any moment."""
    try:
        return os.path.realpath(one) == os.path.realpath(other) or one.samefile(other)
    except (OSError, ValueError):
        return False


def is_name(path: str) -> bool:
    """Returns True if a file can have this name on some file system."""
    try:
        octets = os.fsencode(path)
    except ValueError:
        return False
    if len(octets) > LONGEST_PATH or b"\0" in octets or Path(path).name in ("", ".."):
        return False
    return max(map(len, octets.split(os.sep.encode()))) <= LONGEST_NAME


def _without_waiting(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))
