"""The words of a tag for people: unit and description."""

from typing import Any

from gateway.config.settings.setting_types import Text, Unit
from gateway.config.tags.features.feature import Facts, Feature, Settings
from gateway.tags import Label, Tag


class LabelSettings(Settings):
    unit: Unit = ""
    """The unit of the value, for people: rpm, °C."""
    description: Text = ""
    """A description, for people."""


def _make(_own: Any, facts: Facts) -> Label | None:
    words = Label(facts.settings.unit, facts.settings.description)
    return words if any((words.unit, words.description)) else None


def _meta(tag: Tag) -> dict[str, object]:
    return {"unit": tag.label.unit, "description": tag.label.description}


FEATURE = Feature(
    defaults=LabelSettings,
    computed=frozenset(LabelSettings.model_fields),
    make=_make,
    meta=_meta,
)
