"""A consumer that knows nothing but the schemas that a gateway serves."""

import json
import re
from collections import Counter
from typing import Any, NamedTuple

from tests.schema_check import violations

_PLACES = {  # all others are one chunk
    "tag": "[^@/][^/]*(?:/[^@/][^/]*)*",
    "alarm": "[^@/][^/]*(?:/[^@/][^/]*)*",
    "any": ".*",
    "command": "[a-z]+",
}


class Document(NamedTuple):
    """One kind of document."""

    name: str
    key: re.Pattern[str]
    verbs: list[str]
    schema: dict[str, Any]


def strict(schema: Any) -> Any:
    """Returns the schema without room for what it does not name: a consumer has it, a test not."""
    if isinstance(schema, list):
        return [strict(one) for one in schema]
    if not isinstance(schema, dict):
        return schema
    found = {
        name: strict(one) for name, one in schema.items() if name not in ("examples", "format")
    }
    if isinstance(schema.get("examples"), list):
        found["enum"] = schema["examples"]
    if schema.get("format") == "date-time":
        found["pattern"] = r"^\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{6}Z$"
    if schema.get("type") == "object" and "properties" in schema:
        found["additionalProperties"] = False
    return found


class Reader:
    """Validates documents by their keys. `count`: by kind, those that fit."""

    def __init__(self, described: dict[str, Any], prefix: str) -> None:
        self.count = Counter[str]()
        self.wrong: list[str] = []
        self._shared = strict(described["$defs"])
        self._documents = [
            Document(name, _pattern(one["key"], prefix), one["verbs"], strict(one["schema"]))
            for name, one in described["documents"].items()
        ]

    @property
    def seen(self) -> set[str]:
        """The names of the kinds that were read."""
        return {*self.count}

    @property
    def names(self) -> set[str]:
        return {one.name for one in self._documents}

    def read(self, key: str, verb: str, document: Any) -> None:
        """Notes what is wrong with a document: no kind has its key, or none has its shape."""
        kinds = [one for one in self._documents if verb in one.verbs and one.key.fullmatch(key)]
        fits = [one.name for one in kinds if not self.violations(one.name, document)]
        self.count.update(fits)
        if not fits:
            places = {one.name: self.violations(one.name, document) for one in kinds}
            self.wrong.append(f"{verb} {key}: {places}: {json.dumps(document)[:500]}")

    def violations(self, name: str, document: Any) -> list[str]:
        """Returns the places of a document that are not as its kind."""
        [one] = [one for one in self._documents if one.name == name]
        return violations(document, {**one.schema, "$defs": self._shared})


def _pattern(key: str, prefix: str) -> re.Pattern[str]:
    parts = re.split(r"{(\w+)}", key)
    found = [
        re.escape(part)
        if not place % 2
        else (re.escape(prefix) if part == "prefix" else _PLACES.get(part, "[^@/][^/]*"))
        for place, part in enumerate(parts)
    ]
    return re.compile("".join(found))
