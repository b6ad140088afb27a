"""The contract of a feature of tags.

A feature is one module with `FEATURE`, and one line in `gateway/config/tags/registry.py`.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from pydantic import BaseModel, ConfigDict

from gateway.protocols.driver import Area
from gateway.protocols.typed_fields import TypedField
from gateway.tags import Tag, WriteRule
from gateway.values import ValueType

Problem = tuple[str, str]  # a setting of the tag in the file, and its mistake


class Settings(BaseModel):
    """Settings of a feature in the file. The text below each is the help in editors."""

    model_config = ConfigDict(arbitrary_types_allowed=True, defer_build=True)


class Facts(NamedTuple):
    """The parts of the tag that the checks of a feature may use."""

    kind: ValueType
    text: str  # the address as the file writes it
    settings: Any  # those of the tag, with those that it inherits
    spell: Callable[[], str] = str  # the first address as the driver writes it, or the field
    station: int = 0
    area: Area | None = None  # of the address
    bit: int | None = None  # of its word
    field: TypedField | None = None  # of a frame, which has its own type
    write: WriteRule | None = None
    whole: bool = False  # of a computed value: it has whole numbers only

    @property
    def name(self) -> str:
        return self.spell()


@dataclass(frozen=True, kw_only=True)
class Feature:
    """A feature of tags. Its functions are called only if one of its settings is set.

    `own` is the section of the tag in the file: all its settings, and `model_fields_set`. A setting
    that the tag sets itself must fit; one that it inherits is ignored where it does not.
    """

    defaults: type[Settings] | None = None  # for a tag, or all of a device, a line or the file
    own: type[Settings] | None = None  # for one tag
    computed: frozenset[str] = frozenset()  # settings that a computed tag can have
    check: Callable[[Any, Facts], Iterable[Problem]] | None = None
    make: Callable[[Any, Facts], object | None] | None = None  # what the tag keeps; None: nothing
    slot: str = ""  # the field of `Tag` for it; left out: one of `Tag.features`
    wrap: Callable[[Any, Any, Tag], Tag] | None = None  # returns the tag, or another around it
    meta: Callable[[Tag], Mapping[str, object]] = lambda _tag: {}  # its fields in `@meta`
    names: frozenset[str] = field(init=False)  # of its settings, as pydantic has them

    def __post_init__(self) -> None:
        kinds = [kind for kind in (self.defaults, self.own) if kind is not None]
        names = frozenset(name for kind in kinds for name in kind.model_fields)
        object.__setattr__(self, "names", names)


def for_numbers(own: Any, kind: ValueType, *names: str) -> Iterator[Problem]:
    """Yields settings of numbers at a text or a bit."""
    if not kind.is_number:
        for name in names:
            if name in own.model_fields_set:
                spelt = name.rstrip("_")
                yield spelt, f"a {kind} has no {spelt}: only numbers have"


def for_one(own: Any, kind: ValueType, *names: str) -> Iterator[Problem]:
    """Yields settings that an array cannot have."""
    if kind.count:
        for name in names:
            if getattr(own, name):
                what = f"a {kind} has no {name}: give the element that needs it a tag of its own"
                yield name, what
