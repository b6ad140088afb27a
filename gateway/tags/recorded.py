"""A query of recorded samples, in the order of recording."""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

from gateway.errors import Damaged
from gateway.tags.sample import Sample
from gateway.tags.tag import Tag

# The place of a sample in the order of recording: the file, the run, and the number in the run.
Place = tuple[str, int, int]
# Samples with their places. `Damaged` stands for samples that are lost; the last pair has
# True. A sample without a place is not stored yet: it is found again later.
Recorded = Iterator[tuple[Sample | Damaged | bool, Place | None]]


class RecordedQuery(NamedTuple):
    """The samples of tags (by their `recorded_key`), from after the place `after`.

    `now`: ns since 1970, when the query came.
    """

    tags: Mapping[str, Tag]
    time_range: str
    after: Place | None
    now: int
