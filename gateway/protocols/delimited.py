"""Finds frames that begin with a character of their own, in the bytes of both directions."""

from collections.abc import Callable

from gateway.protocols.listening import Asked, Heard, Noise, Told

# Returns the frame at the beginning of the bytes and its size, with None in its place to skip it;
# 0 while it arrives, None if it is no frame.
Take = Callable[[bytes], tuple[Asked | Told | None, int] | int | None]

_BROKEN = 0.5  # seconds; a frame without end does not wait for the next one


class DelimitedTrafficReader:
    """A `TrafficReader` for frames that begin with one of `starts` and hold none of them."""

    def __init__(self, starts: bytes, longest: int, take: Take) -> None:
        self._starts = frozenset(starts)
        self._longest = longest
        self._take = take
        self._buffer = b""

    def feed(self, data: bytes, silence: float) -> list[Heard]:
        heard: list[Heard] = []
        if self._buffer and silence > _BROKEN:
            heard.append(Noise(self._buffer))
            self._buffer = b""
        self._buffer += data
        while self._buffer:
            found = self._take(self._buffer) if self._buffer[0] in self._starts else None
            if isinstance(found, tuple):
                if found[0] is not None:
                    heard.append(found[0])
                self._buffer = self._buffer[found[1] :]
                continue
            again = self._next_start()
            if found == 0 and not again and len(self._buffer) <= self._longest:
                break
            size = again or len(self._buffer)
            heard.append(Noise(self._buffer[:size]))
            self._buffer = self._buffer[size:]
        return heard

    def _next_start(self) -> int:
        """Returns the place of the next character that begins a frame; 0 if there is none."""
        places = (at for at, byte in enumerate(self._buffer) if at and byte in self._starts)
        return next(places, 0)
