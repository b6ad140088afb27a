"""The JSON schema of the file, for editors that complete and check."""

import ast
import inspect
from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Any, get_type_hints

from pydantic import BaseModel, TypeAdapter

from gateway.config.settings.model import DeviceSection, LineSection
from gateway.config.settings.parsers import BYTES
from gateway.config.settings.sections import file_section
from gateway.config.settings.session_model import Section
from gateway.config.settings.setting_types import (
    DURATION_SCHEMA,
    INTERVAL_SCHEMA,
    NAME_PATTERN,
    TAG_NAME_PATTERN,
)
from gateway.config.settings.validate import dataclasses_in, is_duration
from gateway.config.tags.section import TagDefaults, TagSection
from gateway.config.transfers.settings import TransferSection
from gateway.errors import ConfigError
from gateway.protocols.registry import PROTOCOLS

_TIMES = (DURATION_SCHEMA["pattern"], INTERVAL_SCHEMA["pattern"])
_SECONDS = {"ms": 0.001, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
_PARTS: dict[str, type[Section]] = {"Line": LineSection, "Tag": TagSection, "Defaults": TagDefaults}
_PARTS["Transfer"] = TransferSection
_DEVICE_NAMES = rf"{NAME_PATTERN}|\{{"  # a repeated device has its number in the name: pump-{{n}}
_NAMES_OF_TEMPLATES = {"type": "array", "items": {"type": "string"}}
_USE: dict[str, Any] = {
    "use": {
        "anyOf": [{"type": "string"}, _NAMES_OF_TEMPLATES],
        "description": "The template of the device, or several: docs/templates.md.",
    },
    "repeat": {
        "type": "integer",
        "minimum": 1,
        "maximum": 10_000,
        "description": "Make so many devices; {n} is the number of each, in its name too.",
    },
}
_TEMPLATE: dict[str, Any] = {
    "type": "object",
    "description": "Settings and tags of devices, with expressions such as D{base + 1}.",
    "properties": {
        "parameters": {
            "anyOf": [{"type": "object"}, _NAMES_OF_TEMPLATES],
            "description": "The parameters with their defaults; null: the device gives a value.",
        },
        "use": _USE["use"],
        "description": {"type": "string"},
        "tags": {"type": "object"},
    },
}


def schema() -> dict[str, Any]:
    """Returns the schema. A device has one shape per protocol, each with the common settings."""
    root = _described(file_section())
    shared: dict[str, Any] = root.setdefault("$defs", {})
    for name, part in _PARTS.items():
        shared[name] = _hoisted(_described(part), shared)
    shared["Tag"]["anyOf"] = [{"required": [name]} for name in ("address", "computed")]
    del shared["Tag"]["required"]
    for protocol in PROTOCOLS:
        shared[protocol] = _device(protocol, shared)
    shared["Template"] = _TEMPLATE
    plain = {"not": {"required": ["use"]}}
    shared["Device"] = {
        "type": "object",
        "properties": {"protocol": {"enum": list(PROTOCOLS)}, **_USE},
        "allOf": [
            {"if": plain, "then": {"required": ["protocol"]}},
            *(
                {
                    "if": {"properties": {"protocol": {"const": name}}, "required": ["protocol"]}
                    | plain,
                    "then": _ref(name),
                }
                for name in PROTOCOLS
            ),
        ],
    }
    root["properties"]["templates"]["additionalProperties"] = _ref("Template")
    root["properties"]["lines"] |= _by_name("Line") | {"minProperties": 1}
    root["properties"]["defaults"] = _defaults("file")
    root["properties"]["transfers"]["items"] = _ref("Transfer")
    line = shared["Line"]["properties"]
    line["devices"] |= _by_name("Device", _DEVICE_NAMES) | {"minProperties": 1}
    line["defaults"] = _defaults("line")
    for part in (root, *shared.values()):
        for setting in part.get("properties", {}).values():
            _write_default(setting)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | root


def _described(kind: type[BaseModel]) -> dict[str, Any]:
    """Returns the schema with the text below each field as its description.

    pydantic can do this too, but at each start of the program, which takes 50 ms.
    """
    found = kind.model_json_schema()
    kinds = {one.__name__: one for one in _with_subclasses(BaseModel)}
    for name, part in {**found.get("$defs", {}), kind.__name__: found}.items():
        if name in kinds:
            for setting, text in _texts(kinds[name]).items():
                if setting in part["properties"]:
                    described = part["properties"][setting] | {"description": text}
                    part["properties"][setting] = dict(sorted(described.items()))
    return found


def _with_subclasses(kind: type[BaseModel]) -> Iterator[type[BaseModel]]:
    yield kind
    for one in kind.__subclasses__():
        yield from _with_subclasses(one)


def _texts(kind: type[BaseModel]) -> dict[str, str]:
    """Returns the texts below the fields, by the name in the file."""
    found: dict[str, str] = {}
    for one in reversed(kind.__mro__):
        if not issubclass(one, BaseModel) or one in (BaseModel, file_section()):
            continue
        [tree] = ast.parse(inspect.getsource(one)).body
        body = tree.body if isinstance(tree, ast.ClassDef) else []
        for field, text in pairwise(body):
            match field, text:
                case (
                    ast.AnnAssign(target=ast.Name(id=name)),
                    ast.Expr(value=ast.Constant(value=str(words))),
                ):
                    alias = kind.model_fields[name].alias
                    found[alias or name] = inspect.cleandoc(words)
    return found


def _device(protocol: str, shared: dict[str, Any]) -> dict[str, Any]:
    driver = PROTOCOLS[protocol].settings
    settings = _hoisted(TypeAdapter(driver).json_schema(), shared)["properties"]
    _mend(driver, settings)
    if "station" in settings:
        stations = [number for number in range(256) if _is_station(driver, number)]
        settings["station"] |= {"minimum": stations[0], "maximum": stations[-1]}
    for inner in set(dataclasses_in(driver)):
        shared[inner.__name__] |= {"additionalProperties": False}
        _mend(inner, shared[inner.__name__]["properties"])
    common = _hoisted(_described(DeviceSection), shared)["properties"]
    common["tags"] |= _by_name("Tag", TAG_NAME_PATTERN)
    common["defaults"] = _defaults("device")
    return {
        "type": "object",
        "description": (driver.__doc__ or "").partition("\n")[0],
        "properties": settings | common,
        "required": ["protocol"],
        "additionalProperties": False,
    }


def _is_station(driver: type[Any], number: int) -> bool:
    """Returns True for a station number of the protocol with its default settings."""
    try:
        driver(station=number)
    except ConfigError:
        return False
    return True


def _mend(kind: type[Any], properties: dict[str, Any]) -> None:
    """Corrects the schema of durations, which pydantic takes for numbers."""
    for name, hint in get_type_hints(kind).items():
        if name in properties and is_duration(hint):
            properties[name] = dict(DURATION_SCHEMA)


def _write_default(setting: dict[str, Any]) -> None:
    """Writes a default as the file does: `7d`, not 604800 seconds. Removes null defaults."""
    match setting.get("default", ...), setting.get("pattern"):
        case float(seconds), pattern if pattern in _TIMES:
            setting["default"] = _in_unit(seconds, _SECONDS)
        case int(octets), str():
            setting["default"] = _in_unit(octets, BYTES)
        case dict(), _:
            setting["default"] = {}  # a section: its settings have their own
        case (str(host), int(port)), _:
            setting["default"] = f"{host}:{port}"
        case None, _ if not _may_be_null(setting):
            del setting["default"]


def _may_be_null(setting: dict[str, Any]) -> bool:
    shapes = setting.get("anyOf", [setting])
    return any(shape.get("type") == "null" for shape in shapes) or "$ref" in setting


def _in_unit(amount: float, units: Mapping[str, float]) -> str:
    """Writes an amount in the largest unit that gives a whole number, or the smallest."""
    whole = [unit for unit, size in units.items() if amount and amount % size == 0]
    unit = max(whole, key=units.__getitem__, default=min(units, key=units.__getitem__))
    return f"{amount / units[unit]:g}{unit}"


def _hoisted(part: dict[str, Any], shared: dict[str, Any]) -> dict[str, Any]:
    shared.update(part.pop("$defs", {}))
    return part


def _ref(name: str) -> dict[str, Any]:
    return {"$ref": f"#/$defs/{name}"}


def _by_name(part: str, names: str = NAME_PATTERN) -> dict[str, Any]:
    return {"additionalProperties": _ref(part), "propertyNames": {"pattern": names}}


def _defaults(where: str) -> dict[str, Any]:
    return _ref("Defaults") | {"description": f"Tag settings for every tag of this {where}."}
