"""Replies of the JSON API, and the limits of its requests."""

from collections.abc import Callable

import orjson
from aiohttp import web

from gateway.plant.threads import off_loop

BODY_WITHIN = 5.0  # seconds


def limit(request: web.Request, default: int, most: int) -> int:
    text = request.query.get("limit", str(default))
    if not (text.isascii() and text.isdigit() and len(text) < 9 and 1 <= int(text) <= most):
        raise web.HTTPBadRequest(reason=f"limit is no count from 1 to {most}")
    return int(text)


async def json_off_loop(make: Callable[[], object]) -> web.Response:
    def body() -> bytes:
        return orjson.dumps(make(), default=str, option=orjson.OPT_NON_STR_KEYS)

    return raw(await off_loop(body))


def as_json(found: object) -> web.Response:
    return raw(orjson.dumps(found, default=str, option=orjson.OPT_NON_STR_KEYS))


def raw(body: bytes, status: int = 200) -> web.Response:
    return web.Response(body=body, status=status, content_type="application/json")
