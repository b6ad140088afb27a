"""The section `toy` of the file."""

from typing import Any

from gateway.config.settings.sections import PartSection, Place
from gateway.config.settings.session_model import Section


class ToySection(Section):
    """A part that greets."""

    greeting: str = "hello"
    """The words that it shows."""


def _place(settings: ToySection | None, place: Place) -> Any:
    if settings is not None and not settings.greeting:
        place.mistakes.add("an empty greeting greets nobody: write hello", "toy", "greeting")
    return settings


SECTION = PartSection(name="toy", settings=ToySection, place=_place)
