"""The kinds of resync of a Computer Link station: the loopback TT, or reads of another length.

Some clones are silent about TT. So after the first TT without a reply both are sent in turn, until
the station shows which it answers.
"""

from dataclasses import dataclass

_MISSES = 4  # loopbacks without a reply, in a row, of a station that has answered one
_READ_MISSES = 2


@dataclass(slots=True)
class ResyncKind:
    """The belief about the kind that the station answers. Replies prove it, silence ends it."""

    _loops: bool | None = None  # it answers TT; None: not known
    _looped: bool = False  # it has answered TT once
    _misses: int = 0  # of TT, in a row
    _read_misses: int = 0

    def is_loopback(self, token: int) -> bool:
        """Returns the kind of the resync with this token: True for TT."""
        if self._loops is None:
            return self._misses == 0 or token // 2 % 2 == 0
        return self._loops

    def answered(self, *, loopback: bool) -> None:
        """Notes a reply."""
        if loopback:
            self._loops, self._looped, self._misses = True, True, 0
            return
        self._read_misses = 0
        if self._misses >= (_MISSES if self._looped else 1):
            self._loops = False

    def unanswered(self, *, loopback: bool) -> None:
        """Notes that no sound reply arrived."""
        if loopback:
            self._misses += 1
            if self._loops and self._misses >= _MISSES:
                self._loops = None
            return
        self._read_misses += 1
        if self._loops is False and self._read_misses >= _READ_MISSES:
            self._loops, self._misses = None, 0
