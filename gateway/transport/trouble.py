"""What the system says about a port, in the words of the people who have to go and look."""

import errno
import re
import socket
from collections.abc import Mapping

from gateway.errors import LineDown

_SENTENCES = {
    errno.EBUSY: "in use by another program",
    errno.EAGAIN: "in use by another program",
    errno.EIO: "unplugged, or read by another program as well",
    errno.EADDRINUSE: "this address is in use by another program",
    errno.EADDRNOTAVAIL: "not an address of this computer",
    errno.ECONNREFUSED: "connection refused",
    errno.ECONNRESET: "connection reset by the other side",
    errno.ECONNABORTED: "connection broken off",
    errno.EPIPE: "closed by the other side",
    errno.EHOSTUNREACH: "host cannot be reached",
    errno.ENETUNREACH: "network cannot be reached",
    errno.ETIMEDOUT: "no answer",
    errno.EMFILE: "too many open files",
}
_ERRNO = re.compile(r"\[Errno (\d+)\]")


def line_down(
    name: str, error: BaseException | None, sentences: Mapping[int, str] | None = None
) -> LineDown:
    """`LineDown` with one sentence about the port `name`, whatever exception was met.

    None is what asyncio says when the other side closed in good order. `sentences` are
    better words for some errnos.
    """
    match error:
        case None:
            return LineDown(f"{name}: closed by the other side")
        case LineDown():
            return error
        case socket.gaierror():
            return LineDown(f"{name}: unknown host")
        case TimeoutError() if error.errno is None:
            return LineDown(f"{name}: no answer")
        case OSError():
            return LineDown(f"{name}: {_sentence(error, sentences or {})}")
        case _:
            return LineDown(f"{name}: {error or type(error).__name__}")


def _sentence(error: OSError, better: Mapping[int, str]) -> str:
    number = error.errno
    # A host with several addresses fails with all their errors in one text and no number.
    if number is None and (found := _ERRNO.search(str(error))):
        number = int(found[1])
    words = {**_SENTENCES, **better}.get(number or 0)
    return words or error.strerror or str(error) or type(error).__name__
