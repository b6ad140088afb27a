"""The section of a tag in the file: the settings of all features."""

from typing import Annotated, Any, NamedTuple

from pydantic import create_model

from gateway.config.messages import Mistakes
from gateway.config.settings.session_model import Section
from gateway.config.settings.setting_types import Interval, Text
from gateway.config.tags.registry import FEATURES

_DEFAULTS = [one.defaults for one in FEATURES if one.defaults is not None]
_OWN = [one.own for one in FEATURES if one.own is not None]


class TagDefaults(Section, *reversed(_DEFAULTS)):  # type: ignore[misc]  # mypy sees no features
    """Tag settings for a whole file, line or device."""

    every: Interval = 1.0
    """The interval of reading."""


class TagSection(TagDefaults, *reversed(_OWN)):  # type: ignore[misc]
    """One value of a device."""

    address: Text
    """As the maker writes it: D100, X17, D7.3, holding:100; for frames the name of a field."""
    computed: str | None = None
    """Instead of an address: arithmetic with the names of tags, such as flow_a + flow_b."""


_COMPUTED: dict[str, Any] = {
    name: (Annotated[field.rebuild_annotation(), field], field.default)
    for one in FEATURES
    for kind in (one.defaults, one.own)
    for name, field in (kind.model_fields.items() if kind is not None else ())
    if name in one.computed
}
# A value that is calculated from the values of other tags.
ComputedSection = create_model("Computed", __base__=Section, computed=(Text, ...), **_COMPUTED)


class TagSource(NamedTuple):
    """One tag in the file: its own settings, and those that it inherits.

    An inherited setting that does not fit the tag is ignored (a scale for a bit, `write` for an
    input); a setting of its own must fit.
    """

    device: str
    name: str
    own: Any  # a `TagSection`
    inherited: Any  # `TagDefaults`
    mistakes: Mistakes  # at its place in the file
    type_unknown: bool = False  # its `type` was a mistake: the fit cannot be checked

    @property
    def key(self) -> str:
        return f"{self.device}/{self.name}"

    def sets(self, setting: str) -> bool:
        return setting in self.own.model_fields_set


def inherit(outer: Any, inner: Any) -> Any:
    """Returns the settings of `outer`, replaced by those that `inner` sets itself."""
    given = inner.model_fields_set
    if not given:
        return outer
    replaced = {name: getattr(inner, name) for name in given}
    if "from_" in given:  # one of the two ways to scale replaces the other
        replaced |= {"scale": 1.0, "offset": 0.0}
    elif given & {"scale", "offset"}:
        replaced |= {"from_": None, "to": None}
    return outer.model_copy(update=replaced)
