"""Devices that use templates: expanded to plain data before the file is checked.

Every path of the expanded data knows where it was written: in the file, or in a template. So a
mistake has the place in the template and the device that uses it.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import Any

from gateway.config.messages import Mistakes, Path, meant, one_of, shown
from gateway.config.settings.model import DeviceSection
from gateway.config.settings.validate import driver_settings
from gateway.config.templates.files import Expanded, Origin, Template, Templates
from gateway.config.templates.text import filled, has_parameter
from gateway.config.yaml.file import YamlFile
from gateway.errors import ConfigError
from gateway.protocols.registry import PROTOCOLS

Values = Mapping[str, Any]
_MOST_REPEATS = 10_000
_MOST_PARTS = 2_000_000  # that all templates of a file make; a tag has three or more


@dataclass(slots=True)
class Filler:
    """Fills the data of a template with values, and notes each mistake at its place."""

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


SECTIONS = ("templates", "templates_from")
_OWN = {"use", "repeat"}
_MERGED = ("tags", "defaults")  # name by name


def expanded(file: YamlFile, mistakes: Mistakes, folder: FilePath) -> Mapping[str, Any]:
    """Returns the data without templates; that of a file without templates is not touched.

    `use` of a device is the list of its templates. `mistakes` gets the places of the new data.
    """
    data = file.data
    uses = any("use" in device for device in devices_in(data))
    if not uses and not any(name in data for name in SECTIONS):
        return data
    places = Expanded(file)
    mistakes.places = places
    expansion = _Expansion(Filler(places, mistakes), Templates(file, mistakes, folder))
    rest = {name: value for name, value in data.items() if name not in SECTIONS}
    if isinstance(data.get("lines"), dict):
        rest["lines"] = {name: expansion.line(name, raw) for name, raw in data["lines"].items()}
    return rest


def devices_in(data: Values) -> Iterator[dict[str, Any]]:
    """Yields the settings of every device of a file."""
    for line in _entries(data.get("lines")).values():
        for device in _entries(_entries(line).get("devices")).values():
            yield _entries(device)


def _entries(raw: object) -> dict[str, Any]:
    return raw if isinstance(raw, dict) else {}


class _Expansion:
    def __init__(self, filler: Filler, templates: Templates) -> None:
        self._filler = filler
        self._file = filler.places.file
        self._origins = filler.places.origins
        self._templates = templates

    def line(self, name: str, raw: Any) -> Any:
        devices = _entries(raw).get("devices")
        if not isinstance(devices, dict):
            return raw
        path: Path = ("lines", name, "devices")
        found: dict[str, Any] = {}
        for device, own in devices.items():
            if not isinstance(own, dict) or "use" not in own:
                self._add(found, path, device, device, own)
                continue
            before = len(self._filler.mistakes)
            made = list(self._devices(path, device, own))
            if len(self._filler.mistakes) == before:  # otherwise more would follow from them
                for name_made, settings in made:
                    self._add(found, path, device, name_made, settings)
        if devices and not found:
            self._filler.mistakes.raise_all()
        return {**raw, "devices": found}

    def _add(self, found: dict[str, Any], path: Path, written: str, name: str, raw: Any) -> None:
        if name in found:
            at = Origin(self._file, (*path, written))
            self._filler.note(at, f"a device {name} is on this line already")
        found.setdefault(name, raw)

    def _devices(self, path: Path, name: str, own: Values) -> Iterator[tuple[str, dict[str, Any]]]:
        at = Origin(self._file, (*path, name))
        templates = self._templates.used(own["use"], at.inside("use"), self._filler.note)
        for n in self._filler.numbers(own, name, "n", at) if templates else ():
            counter = {} if n is None else {"n": n}
            made = str(self._filler.data(name, counter, at))
            self._origins[*path, made] = at
            yield made, self._settings(templates, own, counter, at, (*path, made))

    def _settings(
        self,
        templates: Sequence[Template],
        own: Values,
        counter: Values,
        at: Origin,
        place: Path,
    ) -> dict[str, Any]:
        """Returns the settings of the templates, below those of the device itself.

        `at`: where the file has the device; `place`: its path in the expanded data.
        """
        by = (str(place[-1]), at.path)
        found: dict[str, Any] = {}
        values = self._values(templates, own, counter, at, by)
        owners: dict[str, Template] = {}
        for template in templates if values is not None else ():
            origin = Origin(template.file, template.path, by)
            body = self._filled(template.body, values or {}, origin)
            for tag in _entries(body.get("tags")):
                first = owners.setdefault(tag, template)
                if first is not template and first.name not in template.bases:
                    where = Origin(template.file, (*template.path, "tags"), by)
                    what = f"a tag {tag} is in template {first.name} already"
                    self._filler.note(where, what)
            self._merge(found, body, origin, place)
        declared = {name for template in templates for name in template.parameters}
        rest = {k: v for k, v in own.items() if k not in declared and k not in _OWN}
        if values is not None:
            self._merge(found, self._filled(rest, values, at), at, place)
        self._check(rest, found.get("protocol"), templates, at)
        names = own["use"] if isinstance(own["use"], list) else [own["use"]]
        tags = found.pop("tags", None)
        found = {"use": names, **found}
        return found if tags is None else {**found, "tags": tags}

    def _values(
        self,
        templates: Sequence[Template],
        own: Values,
        counter: Values,
        at: Origin,
        by: tuple[str, Path],
    ) -> dict[str, Any] | None:
        """Returns the values of all parameters; None if one is missing."""
        values, missing = dict(counter), False
        declared = {name: t for t in templates for name in t.parameters}
        for name in declared:
            if isinstance(own.get(name, 0), dict | list | None):
                what = f"{shown(own[name])} is no value: write a number or a text, in quotes"
                self._filler.note(at.inside(name), what)
            elif name in own:
                values[name] = self._filler.data(own[name], counter, at.inside(name))
        for name, template in declared.items():
            if name in own:
                missing |= values.get(name) is None
                continue
            origin = Origin(template.file, (*template.path, "parameters", name), by)
            default = template.parameters[name]
            values[name] = self._filler.data(default, values, origin)
            if default is None:
                missing = True
                self._filler.note(at, f"missing: template {template.name} needs {name}")
        return None if missing else values

    def _filled(self, body: Values, values: Values, at: Origin) -> dict[str, Any]:
        """Returns the body with the values, and its repeated tags."""
        plain = {key: item for key, item in body.items() if key != "tags"}
        found: dict[str, Any] = self._filler.data(plain, values, at) or {}
        tags = body.get("tags")
        if isinstance(tags, dict):
            found["tags"] = self._tags(tags, values, at.inside("tags"))
        elif tags is not None:
            found["tags"] = tags
        return found

    def _tags(self, tags: Values, values: Values, at: Origin) -> dict[str, Any]:
        """Returns the tags by name, each as its name in the template and its settings."""
        found: dict[str, Any] = {}
        for name, raw in tags.items():
            place, settings = at.inside(name), raw
            if isinstance(raw, dict) and "repeat" in raw:
                settings = {key: item for key, item in raw.items() if key != "repeat"}
                count = {"repeat": self._filler.data(raw["repeat"], values, place)}
                numbers = self._filler.numbers(count, name, "i", place)
            else:
                numbers = [None]
            for i in numbers:
                known = values if i is None else {**values, "i": i}
                made = str(self._filler.data(name, known, place))
                if made in found:
                    self._filler.note(place, f"a tag {made} is there already")
                found[made] = name, self._filler.data(settings, known, place)
        return found

    def _merge(self, found: dict[str, Any], more: Values, at: Origin, place: Path) -> None:
        """Puts settings over those of `found`, tag by tag; a tag of null is removed."""
        for key, value in more.items():
            origin, inner = at.inside(key), (*place, key)
            if key not in _MERGED or not isinstance(value, dict):
                found[key] = value
                self._origins[inner] = origin
                continue
            known = found.setdefault(key, {})
            if not isinstance(known, dict):  # a mistake of a template, which is told at its place
                continue
            for name, one in value.items():
                if key == "tags":
                    written, settings = one
                    self._merge_tag(known, name, settings, origin.inside(written), (*inner, name))
                else:
                    known[name] = one
                    self._origins[*inner, name] = origin.inside(name)

    def _merge_tag(
        self, tags: dict[str, Any], name: str, settings: Any, origin: Origin, place: Path
    ) -> None:
        known = tags.get(name)
        if settings is None and known is not None:
            del tags[name]
        elif isinstance(known, dict) and isinstance(settings, dict):
            tags[name] = known | settings
            for key in settings:
                self._origins[*place, key] = origin.inside(key)
        else:
            tags[name] = settings
            self._origins[place] = origin

    def _check(
        self, rest: Values, protocol: object, templates: Sequence[Template], at: Origin
    ) -> None:
        """Notes settings of the device that are neither settings nor parameters."""
        if not isinstance(protocol, str) or protocol not in PROTOCOLS:
            return
        known = {*DeviceSection.model_fields, *driver_settings(protocol), "protocol"}
        parameters = [name for template in templates for name in template.parameters]
        names = one_of(template.name for template in templates)
        for key in rest.keys() - known:
            hint = meant(key, [*parameters, *sorted(known - {"protocol"})])
            what = f"no parameter of {names}, and no setting of a {protocol} device: {hint}"
            self._filler.note(at.inside(key), what)
