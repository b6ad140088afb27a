"""Which HTTP requests are answered: names of the machine, origins, tokens, limits."""

import asyncio
from pathlib import Path

import pytest

from gateway.errors import ConfigError
from gateway.parts.web.server import MOST_CONNECTIONS
from tests.web.serving import TOKEN, Client, serving


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
    monkeypatch.setattr("gateway.contract.named_secrets._CHECK_EVERY", 0.0)
    async with serving(host="0.0.0.0", tokens_file=tokens) as client:
        assert (await client.ask("/metrics", Authorization=f"Bearer {TOKEN}")).status == 200
        tokens.write_text("# nobody\n")
        assert (await client.ask("/metrics", Authorization=f"Bearer {TOKEN}")).status == 401


async def test_a_tokens_file_that_others_can_read_is_refused(tokens: Path) -> None:
    tokens.chmod(0o644)
    with pytest.raises(ConfigError, match="open to every user"):
        async with serving(tokens_file=tokens):
            pass


async def test_connections_beyond_the_limit_are_closed_and_the_others_answered() -> None:
    async with serving() as client:
        await asyncio.sleep(0)
        kept = [
            await asyncio.open_connection("127.0.0.1", client.port) for _ in range(MOST_CONNECTIONS)
        ]
        kept[0][1].write(b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        assert b"200 OK" in await asyncio.wait_for(kept[0][0].readline(), 60)
        reader, writer = await asyncio.open_connection("127.0.0.1", client.port)
        assert await asyncio.wait_for(reader.read(), 60) == b""
        for _, one in [*kept, (reader, writer)]:
            one.close()
            await one.wait_closed()
        assert await answers_again(client)


async def answers_again(client: Client) -> bool:
    async with asyncio.timeout(60):
        while True:
            try:
                if (await client.ask("/healthz")).status == 200:
                    return True
            except (OSError, IndexError, ValueError):
                pass


async def test_long_headers_and_bodies_are_refused() -> None:
    async with serving() as client:
        assert (await client.ask("/healthz", X_Long="x" * 9000)).status == 400
        assert (await client.ask("/" + "x" * 9000)).status in (400, 414)
