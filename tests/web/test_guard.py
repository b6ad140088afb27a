"""Which HTTP requests are answered: names of the machine, origins, tokens, limits."""

import asyncio
from functools import partial
from pathlib import Path

import pytest

from gateway.errors import ConfigError
from tests.web.serving import TOKEN, serving


@pytest.mark.parametrize(
    ("host", "status"),
    [
        *(("127.0.0.1:8080", 200), ("localhost", 200), ("[::1]:8080", 200), ("10.0.0.7", 200)),
        *(("evil.example", 421), ("localhost.evil.example:8080", 421), ("", 421), ("[", 421)),
        *(("gateway.plant", 200), ("GATEWAY.plant:8080", 200)),
    ],
)
async def test_only_names_of_this_machine_are_answered(host: str, status: int) -> None:
    async with serving(names=("gateway.plant",)) as client:
        assert (await client.ask("/metrics", Host=host)).status == status


async def test_pages_of_other_sites_get_nothing() -> None:
    async with serving() as client:
        own = f"http://127.0.0.1:{client.port}"
        assert (await client.ask("/metrics", Origin=own)).status == 200
        for origin in ("http://evil.example", "null", own + "1", "file://127.0.0.1"):
            assert (await client.ask("/metrics", Origin=origin)).status == 403
        assert (await client.ask("/metrics", Sec_Fetch_Site="cross-site")).status == 403
        assert (await client.ask("/metrics", Sec_Fetch_Site="same-origin")).status == 200


async def test_pages_of_a_listed_origin_may_read_and_write_with_a_token(tokens: Path) -> None:
    hmi, allowed = "http://hmi.plant:3000", "Access-Control-Allow-Origin"
    async with serving(host="0.0.0.0", tokens_file=tokens, origins=[hmi]) as client:
        asked = await client.ask(
            "/api/write", "OPTIONS", Origin=hmi, Access_Control_Request_Method="POST"
        )
        assert (asked.status, asked.headers[allowed]) == (204, hmi)
        headers = "authorization, content-type, last-event-id"
        assert asked.headers["Access-Control-Allow-Headers"] == headers
        ask = partial(client.ask, "/api/tags", Origin=hmi, Sec_Fetch_Site="cross-site")
        refused = await ask()
        assert (refused.status, refused.headers[allowed]) == (401, hmi)  # its page sees why
        known = await ask(Authorization=f"Bearer {TOKEN}")
        assert (known.status, known.headers["Vary"]) == (200, "Origin")
        assert (await ask(Host="evil.example")).status == 421
        for origin in (f"{hmi}1", "https://hmi.plant:3000", "null", "http://evil.example"):
            for method in ("OPTIONS", "GET", "POST"):
                other = await client.ask("/api/tags", method, Origin=origin)
                assert (other.status, other.headers.get(allowed)) == (403, None)
        assert (await client.ask("/api/tags", "OPTIONS")).status == 401


async def test_other_addresses_need_a_token_for_every_value(tokens: Path) -> None:
    async with serving(host="0.0.0.0", tokens_file=tokens) as client:
        refused = await client.ask("/metrics")
        assert (refused.status, refused.headers["WWW-Authenticate"]) == (401, "Bearer")
        assert (await client.ask("/metrics", Authorization=f"Bearer {TOKEN}1")).status == 401
        assert (await client.ask("/metrics", Authorization=f"Basic {TOKEN}")).status == 401
        assert (await client.ask(f"/metrics?token={TOKEN}")).status == 401
        assert (await client.ask("/metrics", Authorization=f"Bearer {TOKEN}")).status == 200
        assert (await client.ask("/healthz")).status == 200
        assert (await client.ask("/readyz")).status == 200


async def test_a_withdrawn_token_is_refused_within_a_second(
    tokens: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gateway.contract.access.named_secrets._CHECK_EVERY", 0.0)
    monkeypatch.setattr("gateway.contract.access.named_secrets._WAIT", 300.0)
    async with serving(host="0.0.0.0", tokens_file=tokens) as client:
        assert (await client.ask("/metrics", Authorization=f"Bearer {TOKEN}")).status == 200
        reader, writer = await asyncio.open_connection("127.0.0.1", client.port)
        head = f"Host: 127.0.0.1\r\nAuthorization: Bearer {TOKEN}\r\n\r\n"
        writer.write(f"GET /api/events HTTP/1.1\r\n{head}".encode())
        async with asyncio.timeout(300):
            await reader.readuntil(b"event: time")
            tokens.write_text("# nobody\n")
            assert (await client.ask("/metrics", Authorization=f"Bearer {TOKEN}")).status == 401
            await reader.readuntil(b"\r\n0\r\n\r\n")  # the events end too
        writer.close()


async def test_a_tokens_file_that_others_can_read_is_refused(tokens: Path) -> None:
    tokens.chmod(0o644)
    with pytest.raises(ConfigError, match="open to every user"):
        async with serving(tokens_file=tokens):
            pass


async def test_long_headers_and_bodies_are_refused() -> None:
    async with serving() as client:
        assert (await client.ask("/healthz", X_Long="x" * 9000)).status == 400
        assert (await client.ask("/" + "x" * 9000)).status in (400, 414)


@pytest.mark.parametrize(
    ("address", "headers", "body"),
    [
        ("/api/status", {"Authorization": "Bearer \xff"}, b""),
        ("/api/status", {"Authorization": "Bearer ä" + TOKEN}, b""),
        (f"/api/transfers?after={'9' * 5000}", {}, b""),
        ("/api/transfers?after=²", {}, b""),
        ("/api/tags?limit=٣", {}, b""),
        ("/api/status", {"Authorization": f"Bearer {TOKEN}\r"}, b""),
        ("/api/status", {"Authorization": f"Bearer {TOKEN}\rX"}, b""),
        ("/api/status", {"Authorization": f"Bearer {TOKEN}\0"}, b""),
        ("/api/write?tag=mixer/recipe", {"Content_Encoding": "gzip"}, b"no gzip"),
        ("/api/write?tag=mixer/recipe", {"Content_Encoding": "deflate"}, b"no deflate"),
        ("/api/alarms/acknowledge?alarm=a", {"Content_Encoding": "gzip"}, b"no gzip"),
        ("/api/write?tag=mixer/recipe&tag=mixer/speed", {}, b"7"),
    ],
)
async def test_what_cannot_be_understood_is_answered_with_400(
    address: str,
    headers: dict[str, str],
    body: bytes,
    tokens: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with serving(tokens_file=tokens) as client:
        known = {"Content_Type": "application/json", "Authorization": f"Bearer {TOKEN}"}
        answer = await client.ask(address, "POST" if body else "GET", body, **(known | headers))
        assert (answer.status, client.north.written) == (400, [])
    assert TOKEN not in caplog.text
    assert "Traceback" not in caplog.text


async def test_a_body_in_an_unknown_encoding_is_refused(tokens: Path) -> None:
    """Its bytes may be the text of a number."""
    headers = {"Content_Type": "application/json", "Authorization": f"Bearer {TOKEN}"}
    async with serving(tokens_file=tokens) as client:
        for coding, status in (("compress", 415), ("x-own", 415), ("identity", 404)):
            answer = await client.ask(
                "/api/write?tag=mixer/recipe", "POST", b"7", Content_Encoding=coding, **headers
            )
            assert answer.status == status
        assert len(client.north.written) == 1


async def test_a_client_that_leaves_within_its_body_writes_nothing_and_is_no_fault(
    tokens: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with serving(tokens_file=tokens) as client:
        reader, writer = await asyncio.open_connection("127.0.0.1", client.port)
        writer.write(
            b"POST /api/write?tag=mixer/recipe HTTP/1.1\r\nHost: 127.0.0.1\r\n"
            b"Content-Type: application/json\r\nContent-Length: 2\r\n"
            b"Authorization: Bearer %b\r\n\r\n7" % TOKEN.encode()
        )
        writer.write_eof()
        assert await reader.read() == b""
        writer.close()
        assert client.north.written == []
    assert "Traceback" not in caplog.text


async def test_no_body_follows_the_answer_to_head(tokens: Path) -> None:
    """A proxy would take it for the next answer."""
    async with serving(tokens_file=tokens) as client:
        for path, status in (("/api/events", 405), ("/api/status", 200), ("/metrics", 200)):
            head = await client.ask(path, "HEAD", Authorization=f"Bearer {TOKEN}")
            assert (head.status, head.body) == (status, b"")
