"""The templates of a file: its own, those of files beside it, and those that are shipped.

Expanded data has its place in the file, or in a template with the device that uses it.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import Any, NamedTuple

from gateway.config.messages import ConfigErrors, Mistakes, Path, shown, similar
from gateway.config.templates.text import PARAMETER
from gateway.config.yaml.file import YamlFile, read_yaml


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


Note = Callable[[Origin, str], None]
SHIPPED = FilePath(__file__).parent / "shipped"
_RESERVED = {"n", "i", "use", "repeat", "tags", "defaults", "parameters"}
_NO_BODY = {"parameters", "use", "description"}


class Template(NamedTuple):
    """One template. `parameters`: their defaults, None where a device must give a value."""

    name: str
    file: YamlFile
    path: Path
    body: Mapping[str, Any]
    parameters: Mapping[str, Any]
    use: object
    bases: tuple[str, ...] = ()  # that it uses itself


@dataclass(slots=True)
class Templates:
    """Finds templates by name, and notes mistakes in their files."""

    file: YamlFile
    mistakes: Mistakes
    folder: FilePath
    _known: dict[str, Template] = field(default_factory=dict)
    _has_shipped: bool = False

    def __post_init__(self) -> None:
        self._take(self.file, self.mistakes)
        names = self.file.data.get("templates_from")
        if names is None:
            return
        if isinstance(names, str):
            names = [names]
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            what = f"{shown(names)} is no list of files: write [pumps.yaml]"
            self.mistakes.add(what, "templates_from")
            return
        for name in names:
            self._read(self.folder / name)

    def used(self, use: object, at: Origin, note: Note) -> list[Template]:
        """Returns the templates that `use` names, each after those that it uses itself.

        Notes what is wrong, and returns nothing then. `at`: where `use` is written.
        """
        wrong = list[str]()

        def noted(where: Origin, what: str) -> None:
            wrong.append(what)
            note(where, what)

        found = list(self._used(use, at, noted, ()))
        return [] if wrong else found

    def _used(
        self, use: object, at: Origin, note: Note, users: tuple[str, ...]
    ) -> Iterator[Template]:
        for name in use if isinstance(use, list) else [use]:
            if not isinstance(name, str):
                note(at, f"{shown(name)} is no name of a template")
            elif name in users:
                way = " uses ".join([*users[users.index(name) :], name])
                note(at, f"templates use each other without end: {way}")
            elif (template := self._find(name)) is None:
                note(at, f"there is no template {name}{self._hint(name)}")
            else:
                bases = list[Template]()
                if template.use is not None:
                    by = at.by or (str(at.path[-2]), at.path[:-1])
                    place = Origin(template.file, (*template.path, "use"), by)
                    bases = list(self._used(template.use, place, note, (*users, name)))
                yield from bases
                yield template._replace(bases=tuple(base.name for base in bases))

    def _find(self, name: str) -> Template | None:
        if name not in self._known and not self._has_shipped:
            self._has_shipped = True
            for file in sorted(SHIPPED.glob("*.yaml")):
                shipped, mistakes = read_yaml(file, self.file.texts)
                shipped.name = f"{file.name} (shipped)"
                self._take(shipped, mistakes)
        return self._known.get(name)

    def _hint(self, name: str) -> str:
        if close := similar(name, self._known):
            return f": did you mean {close}?"
        own = [known for known in self._known if "/" not in known]
        has = f"the file has {', '.join(own)}; " if own else ""
        return f": {has}docs/templates.md has those that are shipped"

    def _read(self, path: FilePath) -> None:
        try:
            file, mistakes = read_yaml(path, self.file.texts)
        except ConfigErrors as error:
            for message in error.messages:
                self.mistakes.add(message, "templates_from")
            return
        self.mistakes.include(mistakes)
        for name in file.data.keys() - {"templates"}:
            mistakes.add("a file of templates has `templates:` only", name)
        self._take(file, mistakes)

    def _take(self, file: YamlFile, mistakes: Mistakes) -> None:
        raw = file.data.get("templates")
        if raw is None:
            return
        if not isinstance(raw, dict):
            what = f"{shown(raw)} stands where templates are expected, each as `name: settings`"
            mistakes.add(what, "templates")
            return
        for name, body in raw.items():
            path: Path = ("templates", name)
            if not isinstance(body, dict):
                mistakes.add(f"{shown(body)} stands where settings are expected", *path)
                continue
            if (other := self._known.get(name)) is not None:
                at = f"{other.file.name}:{other.file.line(other.path)}"
                mistakes.add(f"a template {name} is in {at} already", *path)
                continue
            settings = {key: value for key, value in body.items() if key not in _NO_BODY}
            parameters = _parameters(body.get("parameters"), mistakes.at(*path, "parameters"))
            self._known[name] = Template(name, file, path, settings, parameters, body.get("use"))


def _parameters(raw: object, mistakes: Mistakes) -> dict[str, Any]:
    """Returns the defaults by name. A list has parameters without defaults."""
    if raw is None:
        return {}
    if isinstance(raw, list):
        raw = dict.fromkeys(map(str, raw))
    if not isinstance(raw, dict):
        mistakes.add(f"{shown(raw)} stands where parameters are expected: [base, count]")
        return {}
    for name in raw:
        if not PARAMETER.match(name):
            mistakes.add(f"{name}: a parameter has letters, digits and _ only", name)
        elif name in _RESERVED:
            mistakes.add(f"{name} has a meaning of its own: choose another name", name)
    return raw
