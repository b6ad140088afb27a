"""Pages of current values."""

import pytest

from gateway.errors import BadValue
from gateway.northbound.answering import pages
from tests.northbound.plant import tag

TAGS = [tag("mixer", name) for name in ("level", "recipe", "speed")]


def test_a_page_begins_with_the_tag_after_the_last_of_the_page_before() -> None:
    assert pages.rest(TAGS, None) == TAGS
    assert pages.rest(TAGS, "mixer/level") == TAGS[1:]
    assert pages.rest(TAGS, "mixer/speed") == []


def test_a_page_after_a_tag_that_is_gone_is_refused() -> None:
    with pytest.raises(BadValue, match="the tags are others now"):
        pages.rest(TAGS, "mixer/valve")
