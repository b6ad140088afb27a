"""The kinds of resync of a station: by its loopback, or by reads.

Some stations are silent about the loopback, or refuse it. So after the first one without a good
reply both are sent in turn, until the station shows which it answers.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from gateway.errors import DeviceError

MISSES = 4  # loopbacks without a good reply, in a row, of a station that has answered one
_DOUBTS = 3  # reads with a good reply after such loopbacks, until only reads are sent
_READ_MISSES = 2


@dataclass(slots=True)
class ResyncKind:
    """The belief about the kind that the station answers. Replies prove it, silence ends it.

    A read that is answered after a lost loopback proves little: noise or an outage may have taken
    the loopback. So it is tried again in the next resyncs.
    """

    _loops: bool | None = None  # it answers loopbacks; None: not known
    _doubts: int = 0  # reads that it answered after lost loopbacks, and no loopback since
    _misses: int = 0  # of loopbacks, in a row
    _read_misses: int = 0
    _sent: tuple[int, bool] = -1, True  # half the token of the last resync, and its kind

    def is_loopback(self, token: int) -> bool:
        """Returns the kind of the resync with this token. That of the last one stays, for its
        reply is judged after it has arrived."""
        sent, loopback = self._sent
        if token // 2 == sent >= 0:
            return loopback
        if self._loops is None:
            return self._misses == 0 or token // 2 % 2 == 0
        return self._loops

    @contextmanager
    def sent(self, token: int, *, loopback: bool) -> Iterator[None]:
        """Notes a resync, and whether it gets a good reply."""
        self._sent = token // 2, loopback
        try:
            yield
        except DeviceError:
            self._unanswered(loopback=loopback)
            raise
        self._answered(loopback=loopback)

    def _answered(self, *, loopback: bool) -> None:
        if loopback:
            self._loops, self._doubts, self._misses = True, 0, 0
            return
        self._read_misses = 0
        if self._loops is None and self._misses:
            self._doubts, self._misses = self._doubts + 1, 0
            self._loops = None if self._doubts < _DOUBTS else False

    def _unanswered(self, *, loopback: bool) -> None:
        if loopback:
            self._misses += 1
            if self._loops and self._misses >= MISSES:
                self._loops = None
            return
        self._read_misses += 1
        if self._loops is False and self._read_misses >= _READ_MISSES:
            self._loops, self._misses = None, 0
