"""The tags as a list of the page: searched, chosen by key, and those of the overview."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property
from heapq import nsmallest
from itertools import islice

from gateway.contract import payload
from gateway.contract.meta import meta_fields
from gateway.plant.plant import Plant
from gateway.tags import AlarmRule, Tag
from gateway.values import Kind

MOST_OF_OVERVIEW = 24  # tags, without `overview` in the file
MOST_CHOSEN = 200  # tags by key
NO_TILE = (Kind.STRING,)


@dataclass(frozen=True)
class _Known:
    """The tags of the present file, in its order."""

    devices: object  # as the plant returned them; others after a reload
    places: Mapping[str, int]  # by key
    tags: Sequence[Tag]

    @cached_property
    def texts(self) -> Sequence[str]:
        """The key and the description of each tag in lower case, for a search."""
        return [f"{tag.key} {tag.label.description}".lower() for tag in self.tags]

    @cached_property
    def overview(self) -> Sequence[Tag]:
        """Tags with an alarm, then those with a history, with a unit, and others."""
        scalar = [one for one in self.tags if not one.layout.type.count]
        shown = [one for one in scalar if one.layout.type.kind not in NO_TILE] or scalar
        ranked = nsmallest(MOST_OF_OVERVIEW, shown, key=_rank)
        return sorted(ranked, key=lambda one: self.places[one.key])


def _rank(tag: Tag) -> tuple[bool, bool, bool]:
    alarm = tag.feature(AlarmRule) is not None
    return not alarm, not tag.publishing.history, not tag.label.unit


class TagList:
    """All tags. Any thread may call it."""

    def __init__(self, plant: Plant, overview: Sequence[str]) -> None:
        self._plant = plant
        self._overview = overview
        self._last = _Known(None, {}, ())

    @property
    def _known(self) -> _Known:
        devices = self._plant.devices()
        if self._last.devices is not devices:
            tags = [tag for device in devices for tag in device.tags]
            places = {tag.key: place for place, tag in enumerate(tags)}
            self._last = _Known(devices, places, tags)
        return self._last

    def has_device(self, name: str) -> bool:
        return any(device.name == name for device in self._plant.devices())

    def select(self, device: str | None, find: str, after: str | None) -> Sequence[Tag]:
        """Returns tags with all words of `find` in key or description, after the tag `after`."""
        known, words = self._known, find.lower().split()
        if not (words or device or after):
            return known.tags
        begin = known.places.get(after, -1) + 1 if after is not None else 0
        return [
            tag
            for tag, text in islice(zip(known.tags, known.texts, strict=True), begin, None)
            if (device is None or tag.device == device) and all(word in text for word in words)
        ]

    def chosen(self, keys: str | None) -> list[Tag]:
        """Returns the tags of keys or patterns with commas, in this order; None: the overview."""
        known = self._known
        wanted = self._overview if keys is None else keys.split(",")
        if not wanted:
            return [*known.overview]
        found: dict[Tag, None] = {}
        for key in wanted[:MOST_CHOSEN]:
            if "*" in key:
                found |= {tag: None for tag in known.tags if fnmatchcase(tag.key, key)}
            elif (place := known.places.get(key)) is not None:
                found[known.tags[place]] = None
        return [*found][:MOST_CHOSEN]

    def fields(self, tag: Tag) -> dict[str, object]:
        """Returns value and description of a tag, as the JSON API has them."""
        rule = tag.feature(AlarmRule)
        return {
            "tag": tag.key,
            **payload.sample_fields(self._plant.sample(tag)),
            **meta_fields(tag),
            "alarm": None if rule is None else dict(rule.limits),
        }
