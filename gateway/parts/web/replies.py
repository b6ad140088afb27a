"""Replies of the JSON API, and the limits of its requests."""

import asyncio
from collections.abc import Callable

import orjson
from aiohttp import web

from gateway.plant.threads import off_loop

BODY_WITHIN = 5.0  # seconds
PIECE_WITHIN = 15.0  # seconds in which a client takes a piece of an answer
_PIECE = 64 * 1024


async def body(request: web.Request) -> bytes:
    """Returns the body of a request. Raises `HTTPException`."""
    try:
        async with asyncio.timeout(BODY_WITHIN):
            return await request.read()
    except TimeoutError:
        reason = f"the body did not arrive within {BODY_WITHIN:g} s"
        raise web.HTTPRequestTimeout(reason=reason) from None
    except web.RequestPayloadError:
        raise web.HTTPBadRequest(reason="the body is not what its headers say") from None


async def send(request: web.Request, found: web.StreamResponse) -> web.StreamResponse:
    """Sends an answer in pieces. Closes the connection of a client that does not take one."""
    if found.prepared or not isinstance(found, web.Response):
        return found  # it was sent
    data = memoryview(found.body if isinstance(found.body, bytes) else b"")
    sent = web.StreamResponse(status=found.status, headers=found.headers)
    sent.content_length = len(data)
    loop = asyncio.get_running_loop()
    try:
        async with asyncio.timeout(PIECE_WITHIN) as limit:
            await sent.prepare(request)
            for start in range(0, len(data) if request.method != "HEAD" else 0, _PIECE):
                await sent.write(data[start : start + _PIECE])
                limit.reschedule(loop.time() + PIECE_WITHIN)
            await sent.write_eof()
    except (TimeoutError, ConnectionError):
        drop(request)
    return sent


def drop(request: web.Request) -> None:
    """Closes the connection at once."""
    if request.transport is not None:
        request.transport.abort()


def answer(status: int, error: str) -> web.Response:
    """Returns an error as JSON."""
    return web.json_response({"error": error}, status=status)


async def json_off_loop(make: Callable[[], object]) -> web.Response:
    def body() -> bytes:
        return orjson.dumps(make(), default=str, option=orjson.OPT_NON_STR_KEYS)

    return raw(await off_loop(body))


def as_json(found: object) -> web.Response:
    return raw(orjson.dumps(found, default=str, option=orjson.OPT_NON_STR_KEYS))


def raw(body: bytes, status: int = 200) -> web.Response:
    return web.Response(body=body, status=status, content_type="application/json")
