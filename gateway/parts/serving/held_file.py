"""The file of held values with `retain: true`: written before a write is acknowledged."""

import os
from collections.abc import Iterable, Mapping
from pathlib import Path

import structlog

from gateway import files
from gateway.errors import Busy
from gateway.stations.served.held import from_text, to_text
from gateway.tags import Tag
from gateway.values import Value

log = structlog.get_logger("gateway")


class HeldFile:
    """One small file. It is replaced as a whole: a lost supply leaves the old or the new one."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def load(self, tags: Iterable[Tag]) -> dict[Tag, Value]:
        """Returns the values of the tags. Moves a file aside that cannot be parsed."""
        try:
            return from_text(files.read(self._path), tags)
        except FileNotFoundError:
            return {}
        except OSError as error:
            log.warning("held values not read", file=str(self._path), why=str(error))
        except ValueError as error:
            aside = self._path.with_name(self._path.name + ".bad")
            log.warning("held values damaged", file=str(self._path), why=str(error))
            try:
                self._path.replace(aside)
            except OSError as failed:
                log.warning("file not moved", file=str(self._path), why=str(failed))
        return {}

    def save(self, values: Mapping[Tag, Value]) -> None:
        """Blocks until the values are on the disk. Raises `Busy`: the file is as before."""
        new = self._path.with_name(self._path.name + ".new")
        try:
            with new.open("wb") as file:
                file.write(to_text(values))
                file.flush()
                os.fsync(file.fileno())
            new.replace(self._path)
        except OSError as error:
            raise Busy(f"{self._path} cannot be written: {error.strerror}; not done") from error
