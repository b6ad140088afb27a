"""Translates the system's errors about a port into sentences for people."""

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
    """Returns `LineDown` with one sentence about the port `name` for any exception.

    None stands for a regular close by the other side, as in asyncio. `sentences` replaces the
    sentences of some errnos.
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


def _sentence(error: OSError, sentences: Mapping[int, str]) -> str:
    number = error.errno
    # A host with several addresses fails with one text for all errors and without a number.
    if number is None and (found := _ERRNO.search(str(error))):
        number = int(found[1])
    sentence = {**_SENTENCES, **sentences}.get(number or 0)
    return sentence or error.strerror or str(error) or type(error).__name__
