"""Decides which HTTP requests are answered: by address, origin and token.

A page of another site must not reach the gateway through the browser of an operator. DNS rebinding
gives such a page our address under its own name, so that only known names count. A token is sent
in a header, never in an address: addresses are kept in logs and histories.
"""

import hmac
import socket
from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from ipaddress import ip_address
from typing import Protocol
from urllib.parse import urlsplit

from aiohttp import web
from aiohttp.typedefs import Handler, Middleware

from gateway.contract.access.named_secrets import NamedSecrets
from gateway.parts.web.connections import Connections, Places, Who
from gateway.parts.web.routes import answer, send
from gateway.parts.web.settings import WebSection

BY = web.RequestKey("by", str)  # the name of the token; empty without a valid one
MOST_OPEN = 64  # requests at once, and of one client; beyond, 503
MOST_OF_CLIENT = 40
MOST_SCRAPES = 8
MOST_SCRAPES_OF_CLIENT = 4
_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
        "img-src 'self' data:; manifest-src 'self'; base-uri 'none'; form-action 'none'; "
        "frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "Server": "plc-gateway",
}
_PREFLIGHT = {
    "Access-Control-Allow-Methods": "GET, POST",
    "Access-Control-Allow-Headers": "authorization, content-type, last-event-id",
    "Access-Control-Max-Age": "600",
}


class Tokens(Protocol):
    def current(self) -> Mapping[str, bytes]:
        """Returns the tokens by the name of their client."""


class Guard:
    """The middleware before every handler. Raises `ConfigError` for a bad tokens file.

    `tokens`: in place of those of the file; then reading needs one on this machine too.
    """

    def __init__(
        self, config: WebSection, connections: Connections, tokens: Tokens | None = None
    ) -> None:
        self._tokens = tokens
        if tokens is None and config.tokens_file is not None:
            self._tokens = NamedSecrets(config.tokens_file, "web.tokens_file")
        self._reads_need_token = tokens is not None or not config.is_local
        self._origins = frozenset(config.origins)
        self._names = {"localhost", socket.gethostname().lower(), *config.names}
        self._connections = connections
        self._requests = Places(MOST_OPEN, MOST_OF_CLIENT, "requests")
        self._scrapes = Places(MOST_SCRAPES, MOST_SCRAPES_OF_CLIENT, "scrapes")

    def middleware(self, open_paths: AbstractSet[str]) -> Middleware:
        """`open_paths`: files and probes. They need no token, because they hold no value, and no
        place, because they wait for nothing."""

        @web.middleware
        async def guarded(request: web.Request, handler: Handler) -> web.StreamResponse:
            with self._connections.busy(request.transport):
                return await self._answered(request, handler, request.path in open_paths)

        return guarded

    async def _answered(
        self, request: web.Request, handler: Handler, is_open: bool
    ) -> web.StreamResponse:
        """Answers in a place of its kind, which is taken until the client has the answer."""
        if (refusal := self._refusal(request, is_open)) is not None:
            return await send(request, refusal)
        if self._is_preflight(request):
            return await send(request, web.Response(status=204))
        if is_open:
            return await send(request, await _outcome(request, handler))
        places = self._scrapes if request.path == "/metrics" else self._requests
        try:
            with places.taken(request.transport) as place:
                return await send(request, await _outcome(request, handler), place)
        except web.HTTPServiceUnavailable as error:
            return await send(request, answer(error.status, error.reason))

    def _refusal(self, request: web.Request, is_open: bool) -> web.Response | None:
        if not self._is_known(request.host):
            return answer(421, f"unknown name {request.host[:100]!r}: see web.names")
        if not self._is_listed(request) and not _is_same_site(request):
            return answer(403, "pages of other sites may not use the gateway")
        if not request.headers.get("Authorization", "").isascii():
            return answer(400, "Authorization is no ASCII text")
        if len(request.query) > len({*request.query}):
            return answer(400, "a parameter is there twice")
        request[BY] = self._name(request)
        if (
            not is_open
            and not self._is_preflight(request)
            and self._needs_token(request)
            and not request[BY]
        ):
            if self._tokens is None:
                return answer(403, "nothing can be written here: the file has no web.tokens_file")
            refusal = answer(401, "a token is needed: send Authorization: Bearer <token>")
            refusal.headers["WWW-Authenticate"] = "Bearer"
            return refusal
        return None

    def _is_listed(self, request: web.Request) -> bool:
        return request.headers.get("Origin", "").lower() in self._origins

    def _is_preflight(self, request: web.Request) -> bool:
        """True where the browser asks on behalf of a listed page: it sends no token itself."""
        return request.method == "OPTIONS" and self._is_listed(request)

    async def add_headers(self, request: web.Request, response: web.StreamResponse) -> None:
        """Called before the headers of each answer are sent."""
        response.headers.update(_HEADERS)
        if self._is_listed(request):
            response.headers["Access-Control-Allow-Origin"] = request.headers["Origin"]
            response.headers["Vary"] = "Origin"
        if self._is_preflight(request):
            response.headers.update(_PREFLIGHT)

    def who(self, request: web.Request) -> Who | None:
        """Returns the client of a request; None when its token was withdrawn since."""
        name = self._name(request)
        if self._needs_token(request) and not name:
            return None
        return Who(name, self._tokens is not None)

    def _needs_token(self, request: web.Request) -> bool:
        return request.method != "GET" or self._reads_need_token

    def _is_known(self, host: str) -> bool:
        """True for an address, and for a name of this machine: rebinding needs a foreign name."""
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        try:
            ip_address(name)
        except ValueError:
            return name in self._names
        return True

    def _name(self, request: web.Request) -> str:
        """Returns the name of the client's token; empty without a valid one."""
        kind, _, token = request.headers.get("Authorization", "").partition(" ")
        if self._tokens is None or kind.lower() != "bearer":
            return ""
        sent, found = token.strip().encode(), ""
        for name, secret in self._tokens.current().items():
            if hmac.compare_digest(sent, secret):
                found = name
        return found


async def _outcome(request: web.Request, handler: Handler) -> web.StreamResponse:
    try:
        return await handler(request)
    except web.HTTPException as error:
        return answer(error.status, error.reason)


def _is_same_site(request: web.Request) -> bool:
    if request.headers.get("Sec-Fetch-Site", "none") not in ("none", "same-origin"):
        return request.method == "GET" and request.path == "/"  # a link to the page
    origin = request.headers.get("Origin")
    if origin is None:
        return True
    scheme, _, host = origin.partition("://")
    return scheme in ("http", "https") and host.lower() == request.host.lower()
