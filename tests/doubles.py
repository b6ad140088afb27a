"""The two doubles of a `Talk`: a script of one transaction, and a wire of bytes."""

from collections.abc import Callable, Coroutine, Iterable
from typing import Any, TypeVar

from gateway.engine.jobs.jobs import Traffic
from gateway.errors import Garbled, NoReply
from gateway.protocols.driver import AnyDriver, Cost

T = TypeVar("T")


def octets(text: str) -> bytes:
    """Hex with spaces, as manuals and vectors print frames."""
    return bytes.fromhex(text)


class Script:
    """A `Talk` that follows a script: ("> 02 30 …", "< 06 30 …"), bytes in hex.

    What the driver sends must be the next `>` line; the `<` lines after it are then heard,
    one piece each. Silence is a `>` with no `<` after it.
    """

    may_echo = False

    def __init__(self, driver: AnyDriver, *lines: str) -> None:
        self._codec: Any = driver.codec()
        self._lines = list(lines)
        self.replies: list[int] = []  # the reply lengths the driver announced

    async def tell(self, frame: Any) -> None:
        sent = self._codec.encode(frame)
        assert self._lines, f"nothing more was to be sent, but {sent.hex(' ')} was"
        line = self._lines.pop(0)
        assert line.startswith(">"), f"the driver spoke when it should hear {line}"
        assert sent.hex(" ") == octets(line[1:]).hex(" ")

    async def ask(self, frame: Any, reply: int, answers: Callable[[Any], T | None]) -> T:
        await self.tell(frame)
        self.replies.append(reply)
        heard = b""
        while self._lines and self._lines[0].startswith("<"):
            data = octets(self._lines.pop(0)[1:])
            heard += data
            for got in self._codec.feed(data):
                answer = answers(got)
                if answer is not None:
                    return answer
        if heard:
            raise Garbled("no answer among what was heard", heard)
        raise NoReply("no answer")

    def guard(self, since: float | None) -> None:
        """Nothing is refused here."""

    def done(self) -> None:
        """The whole script was played."""
        assert not self._lines, f"not played: {self._lines}"


class Wire:
    """A `Talk` over bytes: `respond` gets each request and returns the pieces that come back.

    `bounded`: no more bytes may come back than the driver announced.
    """

    may_echo = may_begin_to_echo = False

    def __init__(
        self,
        driver: AnyDriver,
        respond: Callable[[bytes], Iterable[bytes]],
        *,
        bounded: bool = False,
    ) -> None:
        self._codec: Any = driver.codec()
        self._respond, self._bounded = respond, bounded
        self.sent: list[bytes] = []
        self.received: list[bytes] = []
        self.replies: list[int] = []  # the reply lengths the driver announced
        self.traffic = Traffic()

    def guard(self, since: float | None) -> None:
        """Nothing is refused here."""

    @property
    def cost(self) -> Cost:
        """The characters of all requests and of all bytes that came back."""
        return Cost(len(b"".join(self.sent)), len(b"".join(self.received)))

    async def tell(self, frame: Any) -> None:
        self.sent.append(self._codec.encode(frame))
        self._respond(self.sent[-1])

    async def ask(
        self,
        frame: Any,
        reply: int,
        answers: Callable[[Any], T | None],
        within: float | None = None,
    ) -> T:
        self.sent.append(self._codec.encode(frame))
        self.replies.append(reply)
        pieces = list(self._respond(self.sent[-1]))
        self.received += pieces
        assert not self._bounded or len(b"".join(pieces)) <= reply
        for piece in pieces:
            for got in self._codec.feed(piece):
                answer = answers(got)
                if answer is not None:
                    return answer
        raise NoReply("no reply")


def in_pieces(data: bytes, size: int) -> list[bytes]:
    return [data[at : at + size] for at in range(0, len(data), size)]


def result_of(work: Coroutine[Any, Any, T]) -> T:
    """Runs a coroutine that never waits, without an event loop."""
    try:
        work.send(None)
    except StopIteration as end:
        result: T = end.value
        return result
    raise AssertionError("the coroutine waits")
