"""Fills the data of a template with values, and notes each mistake at its place."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from gateway.config.messages import Mistakes, shown
from gateway.config.templates.places import Expanded, Origin
from gateway.config.templates.text import filled, has_parameter
from gateway.errors import ConfigError

Values = Mapping[str, Any]
_MOST_REPEATS = 10_000
_MOST_PARTS = 2_000_000  # that all templates of a file make; a tag has three or more


@dataclass(slots=True)
class Filler:
    places: Expanded
    mistakes: Mistakes
    _parts: int = 0
    _noted: set[str] = field(default_factory=set)

    def note(self, at: Origin, what: str) -> None:
        line = at.file.line(at.path)
        begin = self.places.begin(line, at)
        if f"{begin}{what}" not in self._noted:
            self._noted.add(f"{begin}{what}")
            self.mistakes.add_at(line, begin, what)

    def numbers(self, raw: Values, name: str, counter: str, at: Origin) -> Sequence[int | None]:
        """Returns the numbers of the repetitions, or None once. `counter` is the parameter that
        has the number; the name must use it."""
        if "repeat" not in raw:
            return [None]
        count, place = raw["repeat"], at.inside("repeat")
        if isinstance(count, bool) or not isinstance(count, int) or not 1 <= count <= _MOST_REPEATS:
            self.note(place, f"{shown(count)} is no count from 1 to {_MOST_REPEATS}")
            return []
        if not has_parameter(name, counter):
            self.note(place, f"the name needs the number too: {name}-{{{counter}}}")
            return []
        return range(1, count + 1)

    def data(self, raw: Any, values: Values, at: Origin) -> Any:
        """Returns the data with the values of its expressions; None where there is a mistake."""
        self._parts += 1
        if self._parts > _MOST_PARTS:
            return None
        if self._parts == _MOST_PARTS:
            self.note(at, "the templates of this file repeat without end: use a smaller `repeat`")
        match raw:
            case str():
                try:
                    return filled(raw, values)
                except ConfigError as error:
                    self.note(at, str(error))
                    return None
            case dict():
                return self._mapping(raw, values, at)
            case list():
                return [self.data(item, values, at.inside(n)) for n, item in enumerate(raw)]
        return raw

    def _mapping(self, raw: Values, values: Values, at: Origin) -> Any:
        if len(raw) == 1 and None in raw.values() and (name := next(iter(raw))) in values:
            self.note(at, f'{{{name}}} without quotes is a mapping in YAML: write "{{{name}}}"')
            return None
        texts = self.places.file.texts
        found: dict[str, Any] = {}
        for key, item in raw.items():
            value = self.data(item, values, at.inside(key))
            is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
            found[key] = str(value) if is_number and key in texts else value
        return found
