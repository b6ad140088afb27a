"""A long block of a device goes out in parts."""

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gateway.contract import payload
from gateway.contract.blocks import LONGEST_BLOCK, parts_of
from gateway.tags import Reason, bad, good
from gateway.values import Value
from tests.northbound.test_payload import NOON, tag


@given(
    st.lists(
        st.tuples(
            st.text("aä–_", min_size=1, max_size=80),
            st.one_of(
                st.text(max_size=250),
                st.integers(-(2**63), 2**63),
                st.floats(),
                st.booleans(),
                st.lists(st.floats(allow_nan=False, allow_infinity=False), max_size=50).map(tuple),
            ),
            st.text(max_size=400),
        ),
        max_size=300,
    )
)
@settings(max_examples=60, suppress_health_check=list(HealthCheck))
def test_a_long_block_is_split_into_parts_that_fit_one_message(
    values: list[tuple[str, Value, str]],
) -> None:
    block = {
        name: bad(tag(name), Reason.GARBLED, NOON, why) if why else good(tag(name), value, NOON)
        for name, value, why in values
    }
    parts = parts_of(block)
    assert [name for part in parts for name in part] == list(block)
    assert all(len(payload.block(part.values())) <= LONGEST_BLOCK for part in parts)


def test_a_block_of_four_thousand_tags_has_several_parts() -> None:
    block = {f"t{n}": bad(tag(f"t{n}"), Reason.NO_REPLY, NOON) for n in range(4000)}
    parts = parts_of(block)
    assert [name for part in parts for name in part] == list(block)
    assert len(parts) > 4
    assert all(len(payload.block(part.values())) <= LONGEST_BLOCK for part in parts)


def test_a_short_block_is_one_part() -> None:
    block = {f"t{n}": good(tag(f"t{n}"), n, NOON) for n in range(300)}
    assert parts_of(block) == [block]
    assert parts_of({}) == []
