"""Whether an adapter hands back what is sent, as far as a line without `echo: true` has shown."""

from dataclasses import dataclass

_SHORTEST = 3  # characters of an answer; fewer are noise


@dataclass(slots=True)
class Adapter:
    """What the answers on one line say of it."""

    echoes: bool | None = None  # None: nothing yet

    def heard(self, request: bytes, heard: bytes, reply: int) -> None:
        """An answer of at most `reply` characters came; `heard` is all since the request.

        Where it is the request once and nothing else, it may be an echo, or an acknowledgement
        that repeats the request. A damaged echo proves nothing either.
        """
        place = heard.find(request)
        if place < 0:
            if len(heard) <= reply:
                self.echoes = False
        elif len(heard) - place - len(request) >= _SHORTEST:
            self.echoes = True
