"""Reads a plain YAML file as a stream, without a tree: three times faster, in little memory.

A plain file has no anchors, tags, merges or mistakes: only mappings, lists and scalars. The tree of
`gateway.config.yaml.file` reads all other files, and finds the lines of mistakes.
"""

from collections.abc import Callable, Collection
from typing import Any

import yaml

from gateway.config.yaml.scalars import scalar

_DEEPEST = 50  # levels; the tree reports deeper ones
_REPORTED = 5  # levels: a device is on the fifth
_PLAIN = (None, "")  # styles of a scalar without quotes


class _NotPlainError(Exception):
    """The file needs the tree."""


def plain_data(
    text: bytes, texts: frozenset[str], report: Callable[[float], None] | None = None
) -> dict[str, Any] | None:
    """Returns the data of a plain file; None for all others.

    `texts`: keys whose values are texts even where they look like numbers. `report` receives the
    share that is read.
    """

    def reported(mark: Any) -> None:
        if report is not None:
            report(min(1.0, mark.index / len(text)))

    if not yaml.__with_libyaml__:
        return None
    try:
        return _Stream(yaml.CBaseLoader(text).get_event, texts, reported).document()
    except (yaml.YAMLError, _NotPlainError):
        return None


def first_sections(
    text: bytes, texts: frozenset[str], names: Collection[str]
) -> dict[str, Any] | None:
    """Returns the sections of a plain file up to the last of `names`; all where one lacks.

    None for a file that is not plain up to there. What follows is not read.
    """
    if not yaml.__with_libyaml__:
        return None
    try:
        stream = _Stream(yaml.CBaseLoader(text).get_event, texts, lambda _mark: None)
        stream.until = frozenset(names)
        return stream.document()
    except (yaml.YAMLError, _NotPlainError):
        return None


class _Stream:
    """The events of one file. Equal texts and numbers become one object."""

    def __init__(
        self, event: Callable[[], Any], texts: frozenset[str], report: Callable[[Any], None]
    ) -> None:
        self._event = event
        self._texts = texts
        self._report = report
        self._names: dict[str, str] = {}
        self._values: dict[str, object] = {}
        self.until: frozenset[str] | None = None  # sections after which the file ends early

    def document(self) -> dict[str, Any]:
        event = self._event
        kinds = [type(event()), type(event()), type(event())]
        if kinds != [yaml.StreamStartEvent, yaml.DocumentStartEvent, yaml.MappingStartEvent]:
            raise _NotPlainError
        data = self._mapping(1)
        if self.until is not None and self.until <= data.keys():
            return data
        if [type(event()), type(event())] != [yaml.DocumentEndEvent, yaml.StreamEndEvent]:
            raise _NotPlainError
        return data

    def _mapping(self, level: int) -> dict[str, Any]:
        event, names, found = self._event, self._names, dict[str, Any]()
        while True:
            key = event()
            if type(key) is yaml.MappingEndEvent:
                if level <= _REPORTED:
                    self._report(key.start_mark)
                return found
            if type(key) is not yaml.ScalarEvent or key.tag or key.anchor:
                raise _NotPlainError
            name = names.setdefault(key.value, key.value)
            if name in found or name == "<<":
                raise _NotPlainError
            found[name] = self._value(event(), level, is_text=name in self._texts)
            if level == 1 and self.until is not None and self.until <= found.keys():
                return found

    def _value(self, event: Any, level: int, *, is_text: bool = False) -> Any:
        if event.anchor or type(event) is yaml.AliasEvent or event.tag or level == _DEEPEST:
            raise _NotPlainError
        if type(event) is yaml.ScalarEvent:
            text = event.value
            if event.style not in _PLAIN or (is_text and text):
                return self._names.setdefault(text, text)
            if text not in self._values:
                self._values[text] = scalar(text)
            return self._values[text]
        if type(event) is yaml.MappingStartEvent:
            return self._mapping(level + 1)
        return self._sequence(level + 1)

    def _sequence(self, level: int) -> list[Any]:
        found = []
        while type(event := self._event()) is not yaml.SequenceEndEvent:
            found.append(self._value(event, level))
        return found
