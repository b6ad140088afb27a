"""Translates the system's errors about a port into sentences for people."""

import errno
import re
import socket
import ssl
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
EXPIRED, REVOKED = 10, 23
# The results of X509_verify_cert of OpenSSL.
CERTIFICATES = {
    3: "`tls: revoked` has no list of the authority that signed its certificate",
    9: "its certificate is not valid yet: compare the clocks",
    EXPIRED: "its certificate has expired: renew it there, or correct the clock here",
    12: "the list of `tls: revoked` has expired: fetch the new one of the authority",
    18: "its certificate is self-signed: give it one of the authority, or name it as `tls: ca`",
    19: "the authority of its certificate is not the one of `tls: ca`",
    20: "the authority of its certificate is not the one of `tls: ca`",
    REVOKED: "its certificate is revoked by `tls: revoked`: give it a new one",
    26: "its certificate is not made for its side of a connection (extended key usage)",
    62: "its certificate has another name: if it is the right device, write that as `tls: name`",
    64: "its certificate has another address: write a name of it as `tls: name`",
}
# 7: another authority of the same name has signed it; 21: the server sends no authority at all.
CERTIFICATES[7] = CERTIFICATES[21] = CERTIFICATES[20]
_REFUSED = "refuses the certificate of this gateway: "
_ALERTS = {  # by the words of OpenSSL, whose beginnings differ between versions
    "certificate expired": f"{_REFUSED}it has expired: renew it here",
    "certificate revoked": f"{_REFUSED}it is revoked: get a new one",
    "decrypt error": f"{_REFUSED}its authority is not known there",  # another one of its name
    "unknown ca": f"{_REFUSED}its authority is not known there",
    "certificate required": f"{_REFUSED}there is none: write `tls: {{certificate: …, key: …}}`",
    "bad certificate": f"{_REFUSED}wrong name, purpose or signature",
    "certificate unknown": f"{_REFUSED}wrong name, purpose or signature",
    "did not return a certificate": "shows no certificate: give it one of the authority",
    "wrong version number": "speaks no TLS at this port: without TLS write tcp://",
    "http request": "speaks no TLS at this port: without TLS write tcp://",
    "unsupported protocol": "speaks no TLS 1.2 or 1.3",
    "protocol version": "speaks no TLS 1.2 or 1.3",
    "handshake failure": "ends the handshake: no common cipher, or it needs a certificate",
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
        case ssl.SSLCertVerificationError():
            why = CERTIFICATES.get(error.verify_code)
            return LineDown(f"{name}: {why or f'its certificate: {error.verify_message}'}")
        case ssl.SSLError():
            said = (error.reason or str(error)).lower().replace("_", " ")
            why = next((text for words, text in _ALERTS.items() if words in said), "")
            return LineDown(f"{name}: {why or f'TLS fails: {said}'}")
        case OSError():
            return LineDown(f"{name}: {sentence_of(error, sentences)}")
        case _:
            return LineDown(f"{name}: {error or type(error).__name__}")


def sentence_of(error: OSError, sentences: Mapping[int, str] | None = None) -> str:
    """Returns the error as a sentence. `sentences` replaces those of some errnos."""
    number = error.errno
    # A host with several addresses fails with one text for all errors and without a number.
    if number is None and (found := _ERRNO.search(str(error))):
        number = int(found[1])
    sentence = {**_SENTENCES, **(sentences or {})}.get(number or 0)
    return sentence or error.strerror or str(error) or type(error).__name__
