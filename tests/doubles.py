"""The two doubles of a `Talk`: a script of frames, a wire of bytes. Nothing waits."""

from collections.abc import Callable, Coroutine, Iterable
from typing import Any, TypeVar

from gateway.errors import Garbled, NoReply
from gateway.protocols.driver import AnyDriver

T = TypeVar("T")


def octets(text: str) -> bytes:
    """Returns the bytes of a frame in hex with spaces, as manuals and vectors print it."""
    return bytes.fromhex(text)


class Script:
    """A `Talk` that follows a script: ("> 02 30 …", "< 06 30 …"), bytes in hex.

    A frame that the driver sends must equal the next `>` line. The driver then receives the `<`
    lines after it, one piece each. A `>` line without `<` lines gives no reply.
    """

    may_echo = False

    def __init__(self, driver: AnyDriver, *lines: str) -> None:
        self._codec: Any = driver.codec()
        self._lines = list(lines)
        self.replies: list[int] = []  # the reply lengths the driver announced

    async def tell(self, frame: Any) -> None:
        sent = self._codec.encode(frame)
        assert self._lines, f"the script is at its end, but the driver sent {sent.hex(' ')}"
        line = self._lines.pop(0)
        assert line.startswith(">"), f"the driver sent a frame instead of receiving {line}"
        assert sent.hex(" ") == octets(line[1:]).hex(" ")

    async def ask(self, frame: Any, reply: int, answers: Callable[[Any], T | None]) -> T:
        await self.tell(frame)
        self.replies.append(reply)
        received = b""
        while self._lines and self._lines[0].startswith("<"):
            data = octets(self._lines.pop(0)[1:])
            received += data
            for got in self._codec.feed(data):
                answer = answers(got)
                if answer is not None:
                    return answer
        if received:
            raise Garbled("no reply in the received bytes", received)
        raise NoReply("no reply")

    def done(self) -> None:
        """Checks that the driver followed the script to its end."""
        assert not self._lines, f"not reached: {self._lines}"


class Wire:
    """A `Talk` over bytes: `respond` gets each request and returns the pieces of the reply."""

    may_echo = False

    def __init__(self, driver: AnyDriver, respond: Callable[[bytes], Iterable[bytes]]) -> None:
        self._driver = driver
        self._respond = respond
        self.sent: list[bytes] = []
        self.replies: list[int] = []  # the reply lengths the driver announced

    async def tell(self, frame: Any) -> None:
        self._send(self._driver.codec(), frame)

    async def ask(self, frame: Any, reply: int, answers: Callable[[Any], T | None]) -> T:
        codec = self._driver.codec()
        self.replies.append(reply)
        received = b""
        for piece in self._send(codec, frame):
            received += piece
            for got in codec.feed(piece):
                answer = answers(got)
                if answer is not None:
                    return answer
        if received:
            raise Garbled("no reply in the received bytes", received)
        raise NoReply("no reply")

    def _send(self, codec: Any, frame: Any) -> Iterable[bytes]:
        self.sent.append(codec.encode(frame))
        return self._respond(self.sent[-1])


def result_of(work: Coroutine[Any, Any, T]) -> T:
    """Runs a coroutine that never waits, without an event loop."""
    try:
        work.send(None)
    except StopIteration as end:
        result: T = end.value
        return result
    raise AssertionError("the coroutine waits")
