"""One transaction for a program without a gateway: the program has the port, and waits for it."""

from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from gateway.errors import NoReply
from gateway.protocols.driver import AnyDriver, Talk

_MOST_BYTES = 4096  # that are no reply: several times the longest one
T = TypeVar("T")


def exchange(
    driver: AnyDriver,
    operation: Callable[[Talk[Any]], Coroutine[Any, Any, T]],
    send: Callable[[bytes], object],
    receive: Callable[[], bytes],
) -> T:
    """Returns what a read, write or resync of a driver returns.

    `receive` returns the next bytes, or none of them after the time-out. Raises what the driver
    raises. After `NoReply` or `Garbled` the reply may still arrive: a resync comes next.
    """
    work = operation(_Talk(driver, send, receive))
    try:
        work.send(None)
    except StopIteration as ended:
        result: T = ended.value
        return result
    raise TypeError(f"{work} waits for something else than its transaction")


class _Talk:
    may_echo = False

    def __init__(
        self, driver: AnyDriver, send: Callable[[bytes], object], receive: Callable[[], bytes]
    ) -> None:
        self._codec = driver.codec()
        self._send = send
        self._receive = receive

    async def tell(self, frame: Any) -> None:
        self._send(self._codec.encode(frame))

    async def ask(self, frame: Any, reply: int, answers: Callable[[Any], T | None]) -> T:
        self._send(self._codec.encode(frame))
        bytes_left = _MOST_BYTES
        while bytes_left > 0 and (data := self._receive()):
            bytes_left -= len(data)
            for received in self._codec.feed(data):
                if (answer := answers(received)) is not None:
                    return answer
        raise NoReply("no reply" if bytes_left > 0 else "bytes without an end, and no reply")
