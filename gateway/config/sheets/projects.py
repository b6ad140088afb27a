"""Projects of other programs as sheets: projects.yaml says which field is which setting.

A project has connections, devices and tags. Its tags become rows with our titles, which are checked
like those of any sheet; its connections become lines.
"""

import json
import re
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import yaml

from gateway.config.sheets import cells
from gateway.errors import ConfigError

_MOST_TAGS = 100_000
_NAMED = 5  # tags in a note
_MOST_YAML = 500_000  # characters: some seconds
_FIELD = re.compile(r"\{([^{}]+)\}")
_COMMENT = re.compile(r"(?m)^\s*//.*$")
_OF_LINE = ("connection", "port", "baudrate", "format", "protocol", "station", "base")
_PARTS = ("table", "number", "bit")
_TABLES = {"0": "coil", "1": "discrete", "3": "input", "4": "holding", "discrete_input": "discrete"}
_TABLES |= {"coils": "coil", "holdings": "holding", "press_counter": "input"}
_TABLES |= dict.fromkeys(("holding_single", "holding_multi"), "holding")

Fields = Mapping[str, str]


@dataclass(slots=True)
class Project:
    """The tags as rows below their titles, and the lines of the file without tags."""

    rows: list[list[str]] = field(default_factory=list)
    lines: dict[str, dict[str, Any]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def read_project(text: str) -> Project | None:
    """Returns the project that the text of a file is; None for a sheet. Raises `ConfigError`."""
    for program, spec in cells.data("projects.yaml").items():
        if re.search(spec["mark"], text):
            try:
                tree = _tree(spec.get("form", "json"), text)
                return _Reader(program, spec).project(tree)
            except (ValueError, yaml.YAMLError, RecursionError) as error:
                wrong = f"this looks like a project of {program}, but: {error}"
                raise ConfigError(wrong) from None
    return None


class _Loader(yaml.SafeLoader):
    """Reads `!secret x` as a text."""


_Loader.add_multi_constructor("!", lambda loader, tag, node: f"!{tag} {node.value}")


def _tree(form: str, text: str) -> object:
    if form == "toml":
        return tomllib.loads(text)
    if form == "yaml":
        if len(text) > _MOST_YAML:
            raise ConfigError(f"it has more than {_MOST_YAML // 10**3} kB")
        return yaml.load(text, _Loader)  # noqa: S506  # a safe loader
    return json.loads(_COMMENT.sub("", text))


def _text(value: object) -> str:
    return json.dumps(value) if isinstance(value, bool) else str(value)


@dataclass(slots=True)
class _Reader:
    program: str
    spec: Mapping[str, Any]
    used: set[str] = field(default_factory=set)
    unused: dict[str, None] = field(default_factory=dict)
    left: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))  # by reason

    def project(self, tree: object) -> Project:
        found, tags = Project(), []
        for place, told in self.spec["tags"].items():
            path = place.split(".")
            root = {path[0]: tree} if isinstance(tree, list) else tree
            for fields in self._walk(root, ["", *path], {}):
                tags.append({**self.spec.get("defaults", {}), **told, **fields})
                if len(tags) > _MOST_TAGS:
                    raise ConfigError(f"the project has more than {_MOST_TAGS} tags")
        rows = [row for one in tags if (row := self._row(one)) is not None]
        for why, names in self.left.items():
            more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
            found.notes.append(f"left out: {', '.join(names[:_NAMED])}{more}, {why}")
        if not rows:
            raise ConfigError(
                "; ".join(["it has no tag that can be read here", *found.notes])[:500]
            )
        _name_devices(rows)
        for row in rows:
            _add_device(found.lines, row)
        titles = list(dict.fromkeys(title for row in rows for title in row if row[title]))
        titles = [title for title in titles if title not in _OF_LINE]
        found.rows = [titles, *([row.get(title, "") for title in titles] for row in rows)]
        known = {*self.used, *(f"{name}.length" for name in self.used)}
        if unused := [name for name in self.unused if name not in known]:
            found.notes.append(f"fields of {self.program} that are not used: {', '.join(unused)}")
        return found

    def _walk(self, node: object, path: Sequence[str], around: Fields) -> Iterator[Fields]:
        """Yields the fields of each tag, with those of all lists around it."""
        if isinstance(node, list):
            for one in node:
                if isinstance(one, dict):  # aliases of lists in lists could grow without end
                    yield from self._walk(one, path, around)
        if not isinstance(node, dict):
            return
        level, *deeper = path
        own = self._fields(node)
        known = {**around, **own, **{f"{level}.{name}": text for name, text in own.items()}}
        if not deeper:
            self.unused |= dict.fromkeys(own)
            yield {**known, **{f"tag.{name}": text for name, text in own.items()}}
            return
        if deeper[0].endswith("*"):
            inner, name = deeper[0].removesuffix("*"), own.get(self.spec["groups"], "")
            if level == inner:
                known["group"] = f"{around['group']}/{name}" if "group" in around else name
            yield from self._walk(node.get(inner), [inner, *deeper], known)
            deeper = deeper[1:]
        yield from self._walk(node.get(deeper[0]), deeper, known)

    def _fields(self, node: Mapping[str, object]) -> dict[str, str]:
        """Returns the fields of an entry as texts, with those of a mapping such as `params`."""
        found: dict[str, str] = {}
        for name, value in node.items():
            match value:
                case dict() if name == "params":
                    found |= self._fields(value)
                case [int() as first, *_] if value == list(range(first, first + len(value))):
                    found |= {name: str(first), f"{name}.length": str(len(value))}
                case str() | int() | float():
                    found[name] = self._said("fields", name, _text(value))
        return found

    def _row(self, fields: Fields) -> dict[str, str] | None:
        """Returns the settings of a tag; None for one that is left out."""
        skip, refuse = self.spec.get("skip", {}), self.spec.get("refuse", {})
        self.used |= {*skip, *refuse}
        if any(fields.get(name) in values for name, values in skip.items()):
            return None
        parts = dict(fields)
        for name, patterns in self.spec.get("split", {}).items():
            self.used.add(name.removeprefix("tag."))
            for pattern in [patterns] if isinstance(patterns, str) else patterns:
                if match := re.search(pattern, fields.get(name, "")):
                    parts |= {k: v for k, v in match.groupdict().items() if v is not None}
        settings = self.spec["settings"].items()
        row = {ours: self._filled(ours, theirs, parts) for ours, theirs in settings}
        if not row["name"]:
            return None
        kind = cells.kind(row["type"], row.get("length", "")) if row["type"] != "string" else "?"
        _set_address(row)
        _set_order(row, kind or "")
        reasons = [
            *(
                f"because of {name} {fields[name]}"
                for name, harmless in refuse.items()
                if fields.get(name, "") not in ("", *harmless)
            ),
            f"of type {row['type']}" * bool(kind and kind not in cells.words("types").values()),
            "without an address" * (not row["address"]),
        ]
        if why := next(filter(None, reasons), ""):
            self.left[why].append(row["name"])
            return None
        return row

    def _filled(self, ours: str, theirs: str | list[str], fields: Fields) -> str:
        """Returns a setting of the first text whose fields are all there."""
        for text in [theirs] if isinstance(theirs, str) else theirs:
            names = _FIELD.findall(text)
            self.used |= {name.removeprefix("tag.") for name in names}
            if all(fields.get(name, "") != "" for name in names):
                filled = _FIELD.sub(lambda match: fields[match[1]], text)
                return self._said("values", ours, filled)
        return ""

    def _said(self, section: str, name: str, text: str) -> str:
        """Returns a value in our words."""
        table = self.spec.get(section, {}).get(name, {})
        known = {_text(key): _text(value) for key, value in table.items()}
        return known.get(text, known.get("else", text))


def _set_address(row: dict[str, str]) -> None:
    """Writes the address of a Modbus table; without one the address stays."""
    table, number, bit = (row.pop(name, "") for name in _PARTS)
    table = _TABLES.get(table, table)
    row.setdefault("address", "")
    if table and not number:
        row["address"] = ""  # it has a form that no pattern knows
    if not (table and number):
        return
    with_bit = f".{bit}" if bit and table in ("holding", "input") else ""
    try:
        first = int(number, 16 if number.startswith("0x") else 10) - int(row.get("base") or 0)
    except ValueError:
        return
    row["address"] = f"{table}:{first}{with_bit}"
    if table in ("discrete", "input"):
        row.pop("write", None)  # what a project says of a switch on an input
    if with_bit or table in ("coil", "discrete"):
        row["type"] = "bool"


def _set_order(row: dict[str, str], kind: str) -> None:
    """Writes the orders of words and bytes, where the type has them."""
    order, order64 = row.pop("order", ""), row.pop("order64", "")
    words, _, swapped = (order64 or order if "64" in kind else order).partition(" ")
    if row["type"] == "bool":
        return
    if re.search("32|64", kind):
        row["word_order"] = words
    if swapped:
        row["byte_order"] = swapped


def _name_devices(rows: Iterable[dict[str, str]]) -> None:
    """Gives each station of each port a name of its own, and each of its tags."""
    stations: dict[str, dict[tuple[str, str], None]] = defaultdict(dict)
    for row in rows:
        row["device"] = cells.name(row["device"]).replace("/", "_")
        stations[row["device"]][row["port"], row["station"]] = None
    seen: Counter[tuple[str, str]] = Counter()
    for row in rows:
        known = list(stations[row["device"]])
        if len(known) > 1:
            numbers = [station for _, station in known]
            at = known.index((row["port"], row["station"]))
            own = row["station"] if len({*numbers}) == len(numbers) else str(at + 1)
            row["device"] = f"{row['device']}-{own}"
        seen[same := (row["device"], cells.name(row["name"]))] += 1
        if seen[same] > 1:  # two channels of which one is shown
            row["name"] = f"{row['name']} no. {seen[same]}"


def _add_device(lines: dict[str, dict[str, Any]], row: Fields) -> None:
    """Adds the device of a tag to the line of its port, where the project says which."""
    if not row["port"] or not row["device"] or not row["protocol"].startswith("modbus-"):
        return
    at = (name for name, line in lines.items() if line["port"] == row["port"])
    if (name := next(at, "")) == "":
        name = cells.name(row["connection"]).replace("/", "_") or row["device"]
        name = name if name not in lines else f"{name}-{len(lines) + 1}"
        wire = ("baudrate", "format") if "://" not in row["port"] else ()
        lines[name] = {"port": row["port"], **_whole(row, wire), "devices": {}}
    device = {"protocol": row["protocol"], **_whole(row, ("station",))}
    lines[name]["devices"].setdefault(row["device"], device)


def _whole(row: Fields, names: Iterable[str]) -> dict[str, str | int]:
    """Returns the settings that the row has, numbers as numbers."""
    found = ((name, row[name]) for name in names if row[name])
    return {name: int(text) if text.isdecimal() else text for name, text in found}
