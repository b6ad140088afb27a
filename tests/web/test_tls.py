"""The page over HTTPS: its certificate, its limits, and the mistakes of its files."""

import asyncio
import ssl
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path

import pytest

from gateway.errors import ConfigError
from gateway.parts.web.connections import MOST_CONNECTIONS
from gateway.parts.web.settings import WebSection, WebTlsSection
from gateway.transport.loop import new_event_loop
from tests.northbound.access import certificates
from tests.web.serving import Client, serving
from tests.web.test_bounds import Streams, connected
from tests.web.test_exposure import warned


@asynccontextmanager
async def secure(client: Client, authority: Path) -> AsyncIterator[Streams]:
    trusted = ssl.create_default_context(cafile=authority)
    reader, writer = await asyncio.open_connection(
        "127.0.0.1", client.port, ssl=trusted, limit=2**16
    )
    try:
        yield reader, writer
    finally:
        writer.transport.abort()


async def answer(client: Client, authority: Path, path: str = "/healthz") -> bytes:
    async with asyncio.timeout(300), secure(client, authority) as (reader, writer):
        writer.write(
            f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n".encode()
        )
        return await reader.read()


def tls(certificate: Path, key: Path) -> WebTlsSection:
    return WebTlsSection.model_construct(certificate=certificate, key=key)


@pytest.mark.parametrize("loop", [asyncio.new_event_loop, new_event_loop])
def test_values_and_events_are_served_over_https(
    tmp_path: Path, loop: object, caplog: pytest.LogCaptureFixture
) -> None:
    made = tls(*certificates(tmp_path)("hall"))

    async def asked() -> None:
        async with serving(tls=made) as client, AsyncExitStack() as stack:
            for number in range(50):  # they close at once, or send nothing, or no TLS
                _, writer = await stack.enter_async_context(connected(client))
                writer.write(b"GET / HTTP/1.1\r\n\r\n" if number % 3 else b"")
                if number % 2:
                    writer.transport.abort()
            whole = await answer(client, tmp_path / "ca.pem", "/api/tags")
            assert whole.startswith(b"HTTP/1.1 200 OK")
            assert b"mixer/speed" in whole
            async with secure(client, tmp_path / "ca.pem") as (reader, writer):
                writer.write(b"GET /api/events HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
                async with asyncio.timeout(300):
                    for _ in range(2):
                        await reader.readuntil(b"event: time")

    with asyncio.Runner(loop_factory=loop) as runner:  # type: ignore[arg-type]  # both make one
        runner.run(asked())
    assert "Traceback" not in caplog.text


async def test_who_begins_no_handshake_closes_the_page_to_nobody(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    made = tls(*certificates(tmp_path)("hall"))
    async with serving(tls=made) as client, AsyncExitStack() as stack:
        silent = [
            await stack.enter_async_context(connected(client)) for _ in range(MOST_CONNECTIONS + 20)
        ]
        assert b"ok" in await answer(client, tmp_path / "ca.pem")
        async with asyncio.timeout(300):
            for reader, _ in silent[:20]:
                assert await reader.read() == b""  # those were the idlest
        async with connected(client, "/healthz") as (reader, _):  # without TLS
            async with asyncio.timeout(300):
                assert b"200" not in await reader.read()
        assert b"ok" in await answer(client, tmp_path / "ca.pem")
    assert "Traceback" not in caplog.text


async def test_a_renewed_certificate_is_taken_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gateway.parts.web.listener.RENEWED", 0.01)
    (old := tmp_path / "old").mkdir()
    (new := tmp_path / "new").mkdir()
    certificate, key = certificates(old)("hall")
    async with serving(tls=tls(certificate, key)) as client:
        assert b"ok" in await answer(client, old / "ca.pem")
        certificate.write_text("half a file")  # while it is written
        assert b"ok" in await answer(client, old / "ca.pem")
        for renewed, file in zip(certificates(new)("hall"), (certificate, key), strict=True):
            file.write_bytes(renewed.read_bytes())
        async with asyncio.timeout(300):
            while True:
                try:
                    assert b"ok" in await answer(client, new / "ca.pem")
                    break
                except ssl.SSLError:
                    await asyncio.sleep(0.01)  # the file is read without a notice


def test_an_address_for_other_machines_with_https_is_not_warned_of(tmp_path: Path) -> None:
    certificate, key = certificates(tmp_path)("hall")
    how = {"listen": "0.0.0.0:8080", "tokens_file": "tokens.txt"}
    files = {"certificate": str(certificate), "key": str(key)}
    assert warned(tmp_path, **how, tls=files) == []
    key.chmod(0o644)
    with pytest.raises(ConfigError, match="open to every user"):
        warned(tmp_path, **how, tls=files)
    key.chmod(0o600)
    certificate.chmod(0o600)
    with pytest.raises(ConfigError, match=r"web\.tls\.key .* is no PEM key"):
        warned(tmp_path, **how, tls={**files, "key": str(certificate)})


def test_the_address_of_the_page_says_https(tmp_path: Path) -> None:
    made = WebSection.model_construct(listen=("::1", 8443), tls=tls(tmp_path, tmp_path))
    assert made.url == "https://[::1]:8443/"
