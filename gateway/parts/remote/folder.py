"""The configuration file on disk, and the earlier ones beside it. Everything here blocks."""

import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from gateway import files
from gateway.config import Config, ConfigErrors, load
from gateway.errors import BadValue

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
        self._next = self.path.with_name(f"{self.path.stem}.next{self.path.suffix}")

    def stage(self, text: str) -> Config:
        """Writes the text beside the file, and checks it there. Raises `BadValue`, `OSError`."""
        self._next.unlink(missing_ok=True)
        with self._next.open("x") as file:
            shutil.copymode(self.path, self._next)
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        try:
            return load(self._next)
        except ConfigErrors as error:
            mistakes = str(error).splitlines()
            more = f" and {len(mistakes) - _MOST_TOLD} more" if len(mistakes) > _MOST_TOLD else ""
            raise BadValue(f"{'; '.join(mistakes[:_MOST_TOLD])}{more}") from None

    def digest(self) -> str:
        """Returns the digest of the file as it is on disk now; empty: it cannot be loaded."""
        try:
            return load(self.path).digest
        except ConfigErrors:
            return ""

    def keep(self, digest: str, now: int) -> str:
        """Copies the file to the earlier ones, and drops the oldest. Returns the name of the
        copy."""
        self._kept.mkdir(mode=0o700, exist_ok=True)
        copy = self._kept / f"{now}-{digest}{self.path.suffix}"
        shutil.copy2(self.path, copy)
        files.sync(copy)
        for old in [*self.earlier()][: -self._keep]:
            old.file.unlink(missing_ok=True)
        return copy.name

    def earlier(self) -> Sequence[Kept]:
        """Returns the earlier files, the oldest first."""
        named = sorted(self._kept.glob(f"*-*{self.path.suffix}")) if self._kept.is_dir() else []
        return [Kept(file, file.stem.partition("-")[2]) for file in named]

    def text(self, kept: Path) -> str:
        """Raises `OSError`; `BadValue` for bytes that are no text."""
        try:
            return files.read(kept).decode()
        except UnicodeDecodeError:
            raise BadValue(f"{kept.name} is no text") from None

    def put(self, earlier: str = "") -> None:
        """Replaces the file by the staged one, or by an earlier one: whole, or not at all. Where
        it is a link, the file behind it."""
        real = Path(os.path.realpath(self.path))
        new = real.with_name(f"{real.name}.new")
        shutil.copy2(self._kept / earlier if earlier else self._next, new)
        files.sync(new)
        new.replace(real)
        files.sync(real.parent)
        self._next.unlink(missing_ok=True)
