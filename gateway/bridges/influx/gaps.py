"""The gaps of devices: since when samples may be missing at the server. On disk, if wanted."""

import asyncio
import json
from contextlib import suppress
from pathlib import Path

from gateway import files
from gateway.bridges.program import say
from gateway.errors import ConfigError, words_of


class Gaps:
    """Times are those of the gateway: RFC 3339 in UTC, so that their order is that of the text."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._open: dict[str, str] = {}
        self._filling: dict[str, str] = {}
        self._sent: dict[str, str] = {}  # the last sample that the server has
        self._there: set[str] = set()
        self._saved: dict[str, str] = {}
        if path is not None:
            with suppress(FileNotFoundError):
                self._saved = _read(path)
            self._sent |= self._saved

    def open(self, device: str, since: str) -> None:
        self._open[device] = min(since, self._open.get(device, since))

    def sent(self, device: str, time: str) -> None:
        self._sent[device] = max(time, self._sent.get(device, time))

    def heard(self, device: str, *, answers: bool) -> None:
        """Called before a sample of a device is queued. One that did not answer before has a gap
        since its last sample at the server."""
        if not answers:
            self._there.discard(device)
        elif device not in self._there:
            self._there.add(device)
            if device in self._sent:
                self.open(device, self._sent[device])

    def take(self, device: str) -> str | None:
        """Returns since when samples of a device may be missing, until they are `filled`."""
        if since := self._open.pop(device, None):
            self._filling[device] = since
        return since

    def filled(self, device: str) -> None:
        """The server has the samples of the gap that was taken."""
        self._filling.pop(device, None)

    async def save(self) -> None:
        """Writes the file, if something changed. A disk that fails is reported."""
        known = {
            device: min(at, self._open.get(device, at), self._filling.get(device, at))
            for device, at in self._sent.items()
        }
        if self._path is None or known == self._saved:
            return
        try:
            await asyncio.to_thread(files.put, self._path, json.dumps(known).encode())
        except OSError as error:
            say(f"{self._path} is not written: {error.strerror}")
        else:
            self._saved = known


def _read(path: Path) -> dict[str, str]:
    try:
        known = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        if isinstance(error, FileNotFoundError):
            raise
        raise ConfigError(f"{path}: {words_of(error)}") from None
    if not isinstance(known, dict) or not all(isinstance(one, str) for one in known.values()):
        raise ConfigError(f"{path} is not a state file of `bridge influx`: remove it")
    return known
