"""The configuration file on disk, and the earlier ones beside it. Everything here blocks."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from gateway import files
from gateway.config import Config, ConfigErrors, load
from gateway.config.whole import patched_text
from gateway.errors import BadValue, ConfigError

_MOST_TOLD = 5  # mistakes in one answer


class Kept(NamedTuple):
    """An earlier file."""

    file: Path
    digest: str


class Folder:
    """The file `path`, which may be a link; `path.kept/` has the last `keep` files."""

    def __init__(self, path: Path, keep: int) -> None:
        self.path = path
        self._keep = keep
        self._kept = self.path.with_name(f"{self.path.name}.kept")

    def checked(self, text: str) -> Config:
        """Returns what the file would be with this text. Raises `BadValue`."""
        try:
            return load(self.path, text=text)
        except ConfigErrors as error:
            mistakes = str(error).splitlines()
            more = f" and {len(mistakes) - _MOST_TOLD} more" if len(mistakes) > _MOST_TOLD else ""
            raise BadValue(f"{'; '.join(mistakes[:_MOST_TOLD])}{more}") from None

    def patched(self, patch: Mapping[str, Any]) -> str:
        """Returns the text of the file with other settings. Raises `BadValue`."""
        try:
            return patched_text(self.path, patch)
        except ConfigError as error:
            raise BadValue(str(error)) from None

    def digest(self) -> str:
        """Returns the digest of the file as it is on disk now; empty: it cannot be loaded."""
        try:
            return load(self.path).digest
        except ConfigErrors:
            return ""

    def keep(self, digest: str, now: int) -> str:
        """Copies the file to the earlier ones, and drops the oldest. Returns the name of the copy,
        which is the newest also after a clock was set back."""
        self._kept.mkdir(mode=0o700, exist_ok=True)
        newest = max((_at(one.file) for one in self.earlier()), default=0)
        copy = self._kept / f"{max(now, newest + 1)}-{digest}{self.path.suffix}"
        files.put(copy, files.read(self.path), self.path.stat().st_mode)
        for old in [*self.earlier()][: -self._keep]:
            old.file.unlink(missing_ok=True)
        return copy.name

    def earlier(self) -> Sequence[Kept]:
        """Returns the earlier files, the oldest first."""
        named = sorted(self._kept.glob(f"*-*{self.path.suffix}"), key=_at)
        return [Kept(file, file.stem.partition("-")[2]) for file in named]

    def text(self, kept: Path) -> str:
        """Raises `OSError`; `BadValue` for bytes that are no text."""
        try:
            return files.read(kept).decode()
        except UnicodeDecodeError:
            raise BadValue(f"{kept.name} is no text") from None

    def put(self, data: bytes) -> None:
        """Replaces the file; where it is a link, the file behind it. Raises `OSError`."""
        real = Path(os.path.realpath(self.path))
        files.put(real, data, real.stat().st_mode)

    def put_back(self, copy: str) -> None:
        """Replaces the file by an earlier one. Raises `OSError`."""
        self.put(files.read(self._kept / copy))


def _at(kept: Path) -> int:
    """Returns the time in the name of an earlier file; 0 for the name of another program."""
    text = kept.name.partition("-")[0]
    return int(text) if text.isdecimal() and len(text) < 20 else 0
