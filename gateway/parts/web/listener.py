"""Serves the routes of an HTTP side: binds the address, and serves until it is cancelled."""

import asyncio
import gzip
import logging
import socket
import ssl
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import structlog
from aiohttp import web
from aiohttp.http_exceptions import HttpProcessingError

from gateway.errors import GatewayError, words_of
from gateway.parts.web import exposure
from gateway.parts.web.connections import Connections
from gateway.parts.web.guard import Guard
from gateway.parts.web.routes import Route
from gateway.parts.web.settings import WebSection
from gateway.plant.threads import off_loop

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

IDLE = 15.0  # seconds without a whole request until a connection is closed
AGAIN = 10.0  # seconds until the address is tried again
RENEWED = 3600.0  # seconds until the certificate is read again
LOADED_WITHIN = 4.0  # seconds: a file system may hang
MOST_BODY = 64 * 1024  # bytes
_KINDS = {
    ".html": "text/html",
    ".js": "text/javascript",
    ".css": "text/css",
    ".svg": "image/svg+xml",
    ".webmanifest": "application/manifest+json",
    ".txt": "text/plain",
}
_BACKLOG = 128  # connections that the system keeps until they are accepted
_HEADER = 8190  # bytes of one line
_ENDS_WITHIN = 0.2  # seconds for requests in progress when the gateway ends
_LINGERS = 0.5  # seconds for the rest of a refused body
_BUFFER = 64 * 1024  # bytes that the system keeps for a client: a slow one must not get old values


def _is_fault_of_ours(record: logging.LogRecord) -> bool:
    """False for bytes that are no HTTP: they may hold a token."""
    found = record.exc_info and record.exc_info[1]
    return not isinstance(found, HttpProcessingError | web.RequestPayloadError)


_FAULTS = logging.getLogger(__name__)
_FAULTS.addFilter(_is_fault_of_ours)


class Listener:
    """One address with its connections."""

    def __init__(
        self,
        config: WebSection,
        guard: Guard,
        connections: Connections,
        routes: Sequence[Route],
        *,
        most_body: int = MOST_BODY,
    ) -> None:
        self._config = config
        self._connections = connections
        self._context: ssl.SSLContext | None = None
        is_open = frozenset(route.path for route in routes if route.is_open)
        self._app = web.Application(
            middlewares=[guard.middleware(is_open)], client_max_size=most_body
        )
        self._app.on_response_prepare.append(guard.add_headers)
        self._app.add_routes([route.registered() for route in routes])

    async def run(self, ready: Callable[[int], None] = lambda _port: None) -> None:
        """Serves until cancelled. Tries again if the address cannot be used: lines are more
        important than the page. `ready` gets the port, when it is bound."""
        runner = web.AppRunner(
            self._app,
            handle_signals=False,
            access_log=None,
            logger=_FAULTS,
            keepalive_timeout=IDLE,
            shutdown_timeout=_ENDS_WITHIN,
            lingering_time=_LINGERS,
            max_line_size=_HEADER,
            max_field_size=_HEADER,
        )
        await runner.setup()
        try:
            await self._load_certificate()
            server = await self._bound(runner)
            try:
                log.info("web page ready", at=self._config.url)
                ready(server.sockets[0].getsockname()[1])
                while True:
                    await asyncio.sleep(RENEWED)
                    await self.renew()
            finally:
                server.close()
        finally:
            await runner.cleanup()

    async def _load_certificate(self) -> None:
        if (tls := self._config.tls) is not None:
            self._context = await off_loop(exposure.context, tls, within=LOADED_WITHIN)

    async def renew(self) -> None:
        try:
            await self._load_certificate()
        except GatewayError as error:
            log.warning("certificate not renewed", why=str(error))

    async def _bound(self, runner: web.AppRunner) -> asyncio.Server:
        handlers = runner.server
        if handlers is None:
            raise AssertionError("the runner is not set up")

        def connection() -> asyncio.Protocol:
            if self._context is not None:
                return self._connections.secured(handlers(), self._context)
            return self._connections.wrapped(handlers())

        logged = ""
        while True:
            try:
                server = await asyncio.get_running_loop().create_server(
                    connection, self._config.host, self._config.port, backlog=_BACKLOG
                )
            except OSError as error:
                if (why := words_of(error)) != logged:
                    log.error("web page not served", at=self._config.url, why=why)  # noqa: TRY400
                logged = why
                await asyncio.sleep(AGAIN)
                continue
            for bound in server.sockets:
                with suppress(OSError):
                    bound.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
            return server


def files_of(folder: Path, start: str) -> list[Route]:
    """Returns the routes of the files of a page; the file `start` is at `/`."""
    return [
        file_route(
            "/" if file.name == start else f"/{file.name}",
            file.read_bytes(),
            _KINDS[file.suffix],
        )
        for file in sorted(folder.iterdir())
    ]


def file_route(path: str, body: bytes, kind: str) -> Route:
    """Returns the route of a file: it holds no value, so it is open."""
    small = gzip.compress(body, mtime=0)

    async def asset(request: web.Request) -> web.Response:
        found = web.Response(body=body, content_type=kind, charset="utf-8")
        found.headers["Vary"] = "Accept-Encoding"
        if "gzip" in request.headers.get("Accept-Encoding", ""):
            found.body, found.headers["Content-Encoding"] = small, "gzip"
        return found

    return Route(path, asset, is_open=True)
