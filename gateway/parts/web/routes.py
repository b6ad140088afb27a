"""The shape of one address of the HTTP side: handler, description and parameters in one place.

The server registers the routes, and `openapi` describes them, from the same list.
"""

from collections.abc import Awaitable, Callable, Mapping
from dataclasses import KW_ONLY, dataclass, field

from aiohttp import web

from gateway.parts.web.schemas import TEXT, Schema

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


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
        make = web.get if self.method == "get" else web.post
        return make(self.path, self.handler)
