"""Every parser with its corpus, and with what comes of it by chance: `tests.fuzz.long` grew it."""

import os

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fuzz.long import kept
from tests.fuzz.parsers import PARSERS, SEEDS

EXAMPLES = int(os.environ.get("EXAMPLES", "60"))
MOST = 5000  # bytes that are changed at random places


@pytest.mark.parametrize("name", PARSERS)
def test_the_corpus_of_a_parser(name: str) -> None:
    inputs = [*SEEDS[name], *kept(name)]
    assert len(inputs) > len(SEEDS[name]), "its corpus is kept"
    for data in inputs:
        PARSERS[name](data)


@pytest.mark.parametrize("name", PARSERS)
@settings(
    max_examples=EXAMPLES, deadline=None, suppress_health_check=list(HealthCheck), database=None
)
@given(data=st.data())
def test_what_comes_of_the_corpus_by_chance(name: str, data: st.DataObject) -> None:
    known = [one for one in (*SEEDS[name], *kept(name)) if len(one) <= MOST]
    one, other = (data.draw(st.sampled_from(known)) for _ in range(2))
    first, last = data.draw(st.integers(0, len(one))), data.draw(st.integers(0, len(other)))
    PARSERS[name](one[:first] + data.draw(st.binary(max_size=6)) + other[last:])
