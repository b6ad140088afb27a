"""Values and reasons in the columns of the file."""

import sqlite3
from contextlib import closing

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.contract.past.timerange import EARLIEST, LATEST
from gateway.parts.history.store.rows import checksum, from_row, to_row, with_checksum
from gateway.tags import Quality, Reason, Sample, good
from gateway.values import Value
from tests.history.recorded import NOON, SPEED

any_value = st.one_of(
    st.booleans(),
    st.integers(-(2**70), 2**70),
    st.sampled_from([2**63 - 1, 2**63, 2**64 - 1, -(2**63)]),
    st.floats(),
    st.text(st.characters(exclude_categories=())),
    st.lists(st.integers(-(2**63), 2**64 - 1)).map(tuple),
    st.lists(st.floats(allow_nan=False, allow_infinity=False)).map(tuple),
    st.lists(st.booleans()).map(tuple),
)


@given(any_value, st.integers(EARLIEST, LATEST))
def test_a_value_comes_back_from_sqlite_unchanged(value: Value, time: int) -> None:
    with closing(sqlite3.connect(":memory:")) as database:
        stored = with_checksum(1, 2, to_row(good(SPEED, value, time)))
        row = database.execute("SELECT ?, ?, ?, ?, ?, ?, ?", stored).fetchone()
    assert checksum(row[:6]) == row[6]
    sample = from_row(SPEED, *row[2:6])
    assert type(sample.value) is type(value)
    assert repr(sample.value) == repr(value)
    assert sample._replace(value=None) == Sample(SPEED, None, Quality.GOOD, time)


@pytest.mark.parametrize("reason", [*Reason, None])
def test_bad_samples_keep_their_reason(reason: Reason | None) -> None:
    sample = Sample(SPEED, None, Quality.BAD, NOON, reason)
    assert from_row(SPEED, *to_row(sample)) == sample
