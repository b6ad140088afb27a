"""The places of expanded data: in the file, or in a template with the device that uses it."""

from dataclasses import dataclass, field
from typing import NamedTuple

from gateway.config.messages import Path
from gateway.config.yaml.file import YamlFile


class Origin(NamedTuple):
    """The place of a part of the expanded data. `by`: the device that uses the template, and its
    place in the file."""

    file: YamlFile
    path: Path
    by: tuple[str, Path] | None = None

    def inside(self, chunk: str | int) -> "Origin":
        return self._replace(path=(*self.path, chunk))


@dataclass(slots=True)
class Expanded:
    """The origins by path, as `Mistakes` needs them. A path without one is that of the file."""

    file: YamlFile
    origins: dict[Path, Origin] = field(default_factory=dict)

    @property
    def name(self) -> str:
        return self.file.name

    def line(self, path: Path) -> int:
        origin = self._origin(path)
        return origin.file.line(origin.path)

    def at(self, line: int, path: Path) -> str:
        return self.begin(line, self._origin(path))

    def begin(self, line: int, origin: Origin) -> str:
        """Returns the beginning of a message: the place, and the device that uses it."""
        begin = origin.file.at(line, origin.path)
        if origin.by is None:
            return begin
        device, path = origin.by
        return f"{begin}used by {device} in line {self.file.line(path)}: "

    def _origin(self, path: Path) -> Origin:
        for length in range(len(path), 0, -1):
            if (origin := self.origins.get(path[:length])) is not None:
                return origin._replace(path=(*origin.path, *path[length:]))
        return Origin(self.file, path)
