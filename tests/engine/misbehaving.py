"""Stations that leave out a reply, or send another one than they would."""

from collections.abc import Callable

from tests.sim.bench import Unruly

Instead = Callable[[bytes], list[bytes] | None]


def intercept(station: Unruly, instead: Instead) -> None:
    """`instead` gets each request to the station first. None: the station hears it."""
    hear = station.answer or station.inner.hear

    def intercepted(data: bytes, now: float) -> list[bytes]:
        replies = instead(data)
        return hear(data, now) if replies is None else replies

    station.answer = intercepted
