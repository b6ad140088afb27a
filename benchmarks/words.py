"""Tags for benchmarks: single words of one area."""

from collections.abc import Iterable

from gateway.protocols.driver import Address, Span, Unit
from gateway.tags import Tag, WriteRule
from gateway.values import Layout, parse_type


def words(
    area: str,
    numbers: Iterable[int],
    every: float,
    *,
    kind: str = "int16",
    writable: Iterable[int] = (),
) -> tuple[Tag, ...]:
    """Makes one tag for each number of `area`, with an interval in seconds."""
    may_write = set(writable)
    return tuple(
        Tag(
            device="plc",
            name=f"t{number}",
            text=f"{area}{number}",
            address=Address(area, number),
            span=Span(area, number, 1),
            unit_kind=Unit.WORD,
            layout=Layout(parse_type(kind)),
            every=every,
            write=WriteRule() if number in may_write else None,
        )
        for number in numbers
    )
