"""The memory of an authority: whom it invited, what it signed and revoked.

Several commands may use the folder at once: each change holds a lock, and is on disk before it is
answered.
"""

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pydantic import BaseModel, ValidationError

from gateway import files
from gateway.errors import ConfigError, GatewayError
from gateway.plant.saved_file import SavedFile

WAITS = 5.0  # seconds for another command
_FILE = "authority.json"


class Invitation(BaseModel):
    """An open code. `until`: s since 1970. `used_by`: the digest of the key that used it; the same
    key may ask again, because the answer may be lost."""

    secret: str
    until: float
    used_by: str = ""


class Entry(BaseModel):
    """One name. `serials`: of its certificates, with their ends in s since 1970. `latest`: the last
    certificate, in PEM form; empty before the first."""

    addresses: list[str]
    is_client: bool
    days: float
    serials: dict[str, float] = {}
    latest: str = ""
    is_revoked: bool = False


class State(BaseModel):
    """The memory of an authority. `at`: host and port where it is reached. `revoked`: serial
    numbers with the time, s since 1970."""

    at: str = ""
    names: dict[str, Entry] = {}
    invitations: dict[str, Invitation] = {}
    revoked: dict[str, float] = {}


def load(folder: Path) -> State:
    """Raises `ConfigError`: without its memory an authority would forget whom it revoked."""
    file = folder / _FILE
    if not file.exists():
        return State()
    try:
        return State.model_validate_json(read(file))
    except ValidationError as error:
        what = f"{error.error_count()} mistakes"
        raise ConfigError(f"{file} is damaged ({what}): restore it from a backup") from None


@contextmanager
def changing(folder: Path) -> Iterator[State]:
    """Yields the state, and keeps its changes, also if an error is raised.

    Forgets codes that have expired: a clock set back does not bring them back. Raises
    `GatewayError`.
    """
    try:
        lock = os.open(folder / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    except OSError as error:
        raise GatewayError(f"{folder}: {error.strerror}") from None
    try:
        _take(lock, folder)
        state = load(folder)
        before, now = state.model_dump_json(), time.time()
        for name, one in list(state.invitations.items()):
            if one.until < now:
                del state.invitations[name]
        try:
            yield state
        finally:
            if state.model_dump_json() != before:
                keep(folder / _FILE, state.model_dump_json(indent=1).encode())
    finally:
        os.close(lock)


def sweep(folder: Path) -> None:
    """Forgets codes that have expired. Raises `GatewayError`."""
    with changing(folder):
        pass


def read(file: Path) -> bytes:
    """Raises `ConfigError`."""
    try:
        return files.read(file)
    except OSError as error:
        raise ConfigError(f"{file}: {error.strerror}") from None


def keep(file: Path, data: bytes) -> None:
    """Replaces a file, which only its owner can read. It is on disk when this returns.

    Raises `GatewayError`.
    """
    saved = SavedFile(file)
    saved.save(data)
    if saved.trouble:
        raise GatewayError(f"{file} cannot be written: {saved.trouble}")


def _take(lock: int, folder: Path) -> None:
    """Raises `GatewayError` while another command holds the folder, which may stand still."""
    until = time.monotonic() + WAITS
    while True:
        try:
            return fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() > until:
                raise GatewayError(f"another command holds {folder}") from None
        time.sleep(0.02)
