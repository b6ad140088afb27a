"""The addresses of the HTTP side: handler, description and parameters in one place; replies.

The server registers the routes, and `openapi` describes them, from the same list.
"""

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import KW_ONLY, dataclass, field

from aiohttp import web

from gateway.contract import payload
from gateway.parts.web.connections import Place
from gateway.parts.web.schemas import TEXT, Schema
from gateway.plant.threads import off_loop

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]
BODY_WITHIN = 5.0  # seconds
PIECE_WITHIN = 15.0  # seconds in which a client takes a piece of an answer
_PIECE = 64 * 1024


@dataclass(frozen=True, slots=True)
class Word:
    """A parameter of text."""

    name: str
    about: str
    required: bool = False
    schema: Schema = field(default_factory=lambda: TEXT)

    def of(self, request: web.Request) -> str | None:
        return request.query.get(self.name)


@dataclass(frozen=True, slots=True)
class Choice:
    """A parameter that is one of several words: the first, if it is left out."""

    name: str
    about: str
    known: tuple[str, ...]
    required: bool = False

    @property
    def schema(self) -> Schema:
        return {**TEXT, "enum": [*self.known], "default": self.known[0]}

    def of(self, request: web.Request) -> str:
        """Raises `HTTPBadRequest`."""
        found = request.query.get(self.name, self.known[0])
        if found not in self.known:
            raise web.HTTPBadRequest(reason=f"{self.name} is none of {', '.join(self.known)}")
        return found


@dataclass(frozen=True, slots=True)
class Count:
    """A parameter that is a whole number. `default`: if it is left out."""

    name: str
    about: str
    least: int
    most: int
    default: int | None = None
    required: bool = False

    @property
    def schema(self) -> Schema:
        default = {} if self.default is None else {"default": self.default}
        return {"type": "integer", "minimum": self.least, "maximum": self.most, **default}

    def of(self, request: web.Request) -> int:
        """Raises `HTTPBadRequest`."""
        text = request.query.get(self.name, str(self.default))
        found = int(text) if text.isascii() and text.isdigit() and len(text) < 10 else -1
        if not self.least <= found <= self.most:
            reason = f"{self.name} is no number from {self.least} to {self.most}"
            raise web.HTTPBadRequest(reason=reason)
        return found


Parameter = Word | Choice | Count
LIMIT = Count("limit", "Items of this page, 200 if left out", 1, 1000, 200)


@dataclass(frozen=True, slots=True)
class Route:
    """One address. Without `about` it is not described: a file of the page."""

    path: str
    handler: Handler
    about: str = ""
    _: KW_ONLY
    method: str = "get"
    parameters: tuple[Parameter, ...] = ()
    body: Schema | None = None
    reply: Schema = field(default_factory=lambda: TEXT)
    kind: str = "application/json"  # of the reply
    done: str = "The answer"  # the meaning of status 200
    errors: Mapping[int, str] = field(default_factory=dict)
    failures: Mapping[int, str] = field(default_factory=dict)  # with the words of an outcome
    is_open: bool = False  # it needs neither a token nor a place

    def registered(self) -> web.RouteDef:
        if self.method == "post":
            return web.post(self.path, self.handler)
        # The answer to HEAD has no body: events would be taken for the next answer.
        return web.get(self.path, self.handler, allow_head=self.kind != "text/event-stream")


async def body(request: web.Request) -> bytes:
    """Returns the body of a request. Raises `HTTPException`."""
    coding = request.headers.get("Content-Encoding", "identity").lower()
    if coding not in ("identity", "gzip", "deflate"):
        raise web.HTTPUnsupportedMediaType(reason="the body has an unknown Content-Encoding")
    try:
        async with asyncio.timeout(BODY_WITHIN):
            return await request.read()
    except TimeoutError:
        reason = f"the body did not arrive within {BODY_WITHIN:g} s"
        raise web.HTTPRequestTimeout(reason=reason) from None
    except (web.RequestPayloadError, ConnectionError):
        raise web.HTTPBadRequest(reason="the body is not what its headers say") from None


async def send(
    request: web.Request, found: web.StreamResponse, place: Place | None = None
) -> web.StreamResponse:
    """Sends an answer in pieces. Closes the connection of a client that does not take one.

    `place` then knows since when a piece waits.
    """
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
                if place is not None:
                    place.untaken_since = loop.time()
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
        return payload.document(make())

    return raw(await off_loop(body))


def as_json(found: object) -> web.Response:
    return raw(payload.document(found))


def raw(body: bytes, status: int = 200) -> web.Response:
    return web.Response(body=body, status=status, content_type="application/json")
