"""The few words of JSON schema that the configuration's schema uses, as an editor reads them."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

_TYPES: dict[str, Any] = {
    "object": dict,
    "array": list,
    "string": str,
    "boolean": bool,
    "null": type(None),
    "integer": int,
    "number": (int, float),
}
_KNOWN = frozenset(
    [
        "$ref",
        "$defs",
        "$schema",
        "type",
        "enum",
        "const",
        "pattern",
        "properties",
        "items",
        "required",
        "additionalProperties",
        "anyOf",
        "oneOf",
        "allOf",
        "if",
        "then",
        "minimum",
        "maximum",
        "minProperties",
        "minItems",
        "maxItems",
        "propertyNames",
        "not",
    ]
)
_ANNOTATIONS = frozenset({"title", "description", "default", "examples", "format"})


def violations(value: Any, schema: dict[str, Any]) -> list[str]:
    """The places in `value` that break the schema, as `/lines/hall/port`."""
    return list(dict.fromkeys(_Check(schema).broken(value, schema, "")))


@dataclass(frozen=True)
class _Check:
    root: dict[str, Any]

    def broken(self, value: Any, rule: dict[str, Any], at: str) -> Iterator[str]:
        unknown = rule.keys() - _KNOWN - _ANNOTATIONS
        assert not unknown, f"this check does not know {unknown}"
        if "$ref" in rule:
            name = rule["$ref"].removeprefix("#/$defs/")
            yield from self.broken(value, self.root["$defs"][name], at)
        if not _fits(value, rule):
            yield at
        if isinstance(value, dict):
            yield from self._mapping(value, rule, at)
        if isinstance(value, list):
            if not rule.get("minItems", 0) <= len(value) <= rule.get("maxItems", len(value)):
                yield at
            for i, inner in enumerate(value):
                yield from self.broken(inner, rule.get("items", {}), f"{at}/{i}")
        yield from self._choices(value, rule, at)

    def _mapping(self, value: dict[str, Any], rule: dict[str, Any], at: str) -> Iterator[str]:
        if not set(rule.get("required", ())) <= value.keys():
            yield at
        if len(value) < rule.get("minProperties", 0):
            yield at
        for name in value:
            if list(self.broken(name, rule.get("propertyNames", {}), at)):
                yield f"{at}/{name}"
        extra = rule.get("additionalProperties", {})
        for name, inner in value.items():
            inner_rule = rule.get("properties", {}).get(name, extra)
            if inner_rule is False:
                yield at
            elif inner_rule is not True:
                yield from self.broken(inner, inner_rule, f"{at}/{name}")

    def _choices(self, value: Any, rule: dict[str, Any], at: str) -> Iterator[str]:
        for choice in ("anyOf", "oneOf"):
            if choice in rule and all(list(self.broken(value, r, at)) for r in rule[choice]):
                yield at
        if "not" in rule and not list(self.broken(value, rule["not"], at)):
            yield at
        for part in rule.get("allOf", ()):
            yield from self.broken(value, part, at)
        if "if" in rule and not list(self.broken(value, rule["if"], at)):
            yield from self.broken(value, rule["then"], at)


def _fits(value: Any, rule: dict[str, Any]) -> bool:
    names = rule.get("type", [])
    names = names if isinstance(names, list) else [names]
    if names and not any(_is(value, name) for name in names):
        return False
    if "enum" in rule and value not in rule["enum"]:
        return False
    if "const" in rule and value != rule["const"]:
        return False
    if isinstance(value, str) and not re.search(rule.get("pattern", ""), value):
        return False
    number = isinstance(value, (int, float))
    return not number or rule.get("minimum", value) <= value <= rule.get("maximum", value)


def _is(value: Any, name: str) -> bool:
    return isinstance(value, _TYPES[name]) and (name == "boolean" or not isinstance(value, bool))
