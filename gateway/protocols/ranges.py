"""Ranges of addresses as people write them: `D100..D119`."""

import re
from collections.abc import Iterator

from gateway.errors import ConfigError
from gateway.protocols.driver import AnyDriver, Span
from gateway.protocols.typed_fields import TypedFields

_NUMBERED = re.compile(r"(.*?)([0-9]+)\Z")


def addresses(driver: AnyDriver, text: str, most: int) -> tuple[str, range]:
    """Parses `D100..D119`, `D100..119`, `D100`: an area and its numbers, `most` at most.

    Raises `ConfigError`.
    """
    if isinstance(driver, TypedFields):
        raise ConfigError(f"{driver.protocol} has fields with types: use `read`")
    begin, dots, end = (part.strip() for part in text.partition(".."))
    if dots and end.isdecimal() and (match := _NUMBERED.match(begin)):
        end = match[1] + end
    first, last = driver.address(begin), driver.address(end if dots else begin)
    if first.bit is not None or last.bit is not None:
        raise ConfigError(f"{text}: name the words, without a bit behind them")
    if first.area != last.area:
        raise ConfigError(f"{text}: {begin} and {end} are of two kinds: peek each for itself")
    if first.number > last.number:
        raise ConfigError(f"{text} is no range: write the first and the last, such as D100..D119")
    if not driver.areas[first.area].readable:
        raise ConfigError(f"{begin} cannot be read at station {driver.station}")
    if last.number - first.number >= most:
        raise ConfigError(f"{text} has more than {most} addresses")
    return first.area, range(first.number, last.number + 1)


def spans(driver: AnyDriver, area: str, numbers: range) -> Iterator[Span]:
    """Yields the range in parts that one request each can read. Raises `ConfigError`."""
    start, size = numbers.start, len(numbers)
    while start < numbers.stop:
        size = min(size, numbers.stop - start)
        while driver.cost(span := Span(area, start, size)) is None:
            if size == 1:
                raise ConfigError(f"{area}{start} cannot be read at station {driver.station}")
            size = (size + 1) // 2
        yield span
        start += size
