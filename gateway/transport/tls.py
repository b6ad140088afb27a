"""TLS 1.2 and 1.3 of a connection: as Modbus/TCP Security needs it, on either side."""

import asyncio
import ssl
import time
from pathlib import Path
from typing import Any

from gateway.errors import LineDown
from gateway.transport.asn1 import revoked_numbers
from gateway.transport.os_errors import CERTIFICATES, EXPIRED, REVOKED, line_down
from gateway.transport.port import Port, TlsConfig
from gateway.transport.stream import StreamPort

# Seconds. Renewed files count for new connections, without a restart; a list of revoked
# certificates for open ones, too.
READ_AGAIN = 60.0
_NO_TLS = "TLS did not begin: is this its port for TLS? Without TLS write tcp://"


def make_context(tls: TlsConfig, *, serves: bool) -> ssl.SSLContext:
    """Reads the files. Blocks. Raises `LineDown`, without the name of the port."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER if serves else ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN  # `ca` may be the one certificate itself
    if serves:
        context.verify_mode = ssl.CERT_REQUIRED if tls.mutual else ssl.CERT_NONE
    file = tls.ca
    try:
        for file in filter(None, (tls.ca, tls.revoked)):
            context.load_verify_locations(file)
        if tls.revoked is not None:
            context.verify_flags |= ssl.VERIFY_CRL_CHECK_LEAF
        if (file := tls.certificate) is not None:
            context.load_cert_chain(file, tls.key, password="")
    except ssl.SSLError as error:
        why = "no PEM file, or certificate and key do not belong together"
        raise LineDown(f"{file}: {why}") from error
    except OSError as error:
        raise LineDown(f"{file}: {error.strerror}") from error
    return context


class ServerFiles:
    """The certificates of a port of this machine."""

    def __init__(self, tls: TlsConfig) -> None:
        self.tls = tls
        self._context: ssl.SSLContext | None = None
        self._read_at = 0.0

    async def context(self) -> ssl.SSLContext:
        """Raises `LineDown`. Files that are half renewed do not take the place of good ones."""
        now = asyncio.get_running_loop().time()
        if self._context is None or now - self._read_at > READ_AGAIN:
            self._read_at = now
            try:
                self._context = await asyncio.to_thread(make_context, self.tls, serves=True)
            except LineDown:
                if self._context is None:
                    raise
        return self._context


async def begin_tls(port: StreamPort, context: ssl.SSLContext, *, within: float, host: str) -> None:
    """Begins TLS on an open connection. Raises `LineDown`; the port is lost then.

    `host`: the name that the other side must have in its certificate.
    """
    loop, plain = asyncio.get_running_loop(), port.transport
    failure: LineDown | None = LineDown(f"{port.name}: closed")
    if plain is None:
        raise LineDown(f"{port.name}: closed")
    try:
        async with asyncio.timeout(within):
            transport = await loop.start_tls(
                plain,
                port,
                context,
                server_hostname=host,
                ssl_handshake_timeout=within + 1.0,  # seconds; it has to be some
            )
        if transport is None:  # it was closed meanwhile
            raise ConnectionResetError
        failure = None
    except OSError as error:
        failure = not_begun(port.name, error)
        raise failure from error
    finally:
        if failure is not None:
            plain.abort()
            port.connection_lost(failure)  # the loop has taken the connection from it
    port.use(transport)


def not_begun(name: str, error: OSError) -> LineDown:
    """Returns why TLS did not begin."""
    if isinstance(error, ConnectionError | ssl.SSLEOFError | TimeoutError):
        return LineDown(f"{name}: {_NO_TLS}")
    return line_down(name, error)


def watch(port: StreamPort, tls: TlsConfig) -> None:
    """Ends a connection when the certificate of the other side ends, or is revoked: TLS looks at it
    only once, and a connection lasts for years. Nothing is watched where it has shown none."""
    if found := _shown_by(port):
        port.watching = asyncio.create_task(_watch(port, tls, found))


async def _watch(port: StreamPort, tls: TlsConfig, found: dict[str, Any]) -> None:
    ends, number = ssl.cert_time_to_seconds(found["notAfter"]), int(found["serialNumber"], 16)
    while not await port.is_lost(min(READ_AGAIN, max(0.0, ends - _wall()))):
        if _wall() >= ends:
            port.break_off(CERTIFICATES[EXPIRED])
        elif tls.revoked is not None and number in await asyncio.to_thread(_revoked, tls.revoked):
            port.break_off(CERTIFICATES[REVOKED])


def _revoked(file: Path) -> set[int]:
    try:
        return revoked_numbers(file.read_text("ascii", "replace"))
    except OSError:  # a new connection says so
        return set()


def _wall() -> float:
    return time.time()


def _shown_by(port: StreamPort) -> dict[str, Any]:
    """Returns the certificate of the other side, as `ssl` shows it; empty: it has shown none."""
    transport = port.transport
    return (transport.get_extra_info("peercert") if transport is not None else None) or {}


def names_of(port: StreamPort) -> set[str]:
    """Returns the names in the certificate of the other side, in lower case."""
    certificate = _shown_by(port)
    pairs = [pair for part in certificate.get("subject", ()) for pair in part]
    pairs += certificate.get("subjectAltName", ())
    return {text.lower() for kind, text in pairs if kind in ("commonName", "DNS", "IP Address")}


def certificate_of(port: Port) -> bytes:
    """Returns the certificate of the other side (DER); empty: it has shown none."""
    transport = port.transport if isinstance(port, StreamPort) else None
    found = transport.get_extra_info("ssl_object") if transport is not None else None
    return b"" if found is None else found.getpeercert(binary_form=True) or b""
