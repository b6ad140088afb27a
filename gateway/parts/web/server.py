"""The HTTP server: binds the address, and serves until it is cancelled.

Whatever its clients do, the lines go on: connections and requests are limited, slow clients are
dropped, and answers of a large plant are made on threads.
"""

import asyncio
import gzip
import json
import logging
import socket
import ssl
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import structlog
from aiohttp import web
from aiohttp.http_exceptions import HttpProcessingError

from gateway.config import Config
from gateway.errors import GatewayError
from gateway.parts.web import exposure, metrics, openapi
from gateway.parts.web.alarms import AlarmApi
from gateway.parts.web.api import Api
from gateway.parts.web.connections import Connections
from gateway.parts.web.events import Events, Loads
from gateway.parts.web.guard import Guard
from gateway.parts.web.routes import Route
from gateway.parts.web.settings import WebSection
from gateway.parts.web.tag_list import TagList
from gateway.plant.part import Core, Routed
from gateway.plant.threads import off_loop
from gateway.tags import Tag

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

IDLE = 15.0  # seconds without a whole request until a connection is closed
AGAIN = 10.0  # seconds until the address is tried again
RENEWED = 3600.0  # seconds until the certificate is read again
LOADED_WITHIN = 4.0  # seconds: a file system may hang
SCRAPE_AGE = 1.0  # seconds that the state in the metrics may be old
_FOLDER = Path(__file__).parent / "assets"
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


class Server:
    """The HTTP side of one gateway. Raises `ConfigError` for a bad tokens file."""

    def __init__(self, config: WebSection, core: Core) -> None:
        self._config = config
        self._core = core
        tags = TagList(core.plant, config.overview)
        self._api = Api(core, tags)
        self._loads = Loads(core)
        self._connections = Connections()
        self._context: ssl.SSLContext | None = None
        guard = Guard(config, self._connections)
        events = Events(core, tags, self._loads, guard.who)
        routes = [
            *self._api.routes(),
            *AlarmApi(core).routes(),
            *(
                Route(path=one.path, handler=one.handler, method=one.method.lower())
                for part in core.others.each(Routed)
                for one in part.routes()
            ),
            *events.routes(),
            *self._probes(),
            *_page(),
        ]
        self.description = openapi.document(routes)
        text = json.dumps(self.description, indent=2).encode()
        routes.append(_file("/openapi.json", text, "application/json"))
        is_open = frozenset(route.path for route in routes if route.is_open)
        self._app = web.Application(
            middlewares=[guard.middleware(is_open)], client_max_size=64 * 1024
        )
        self._app.on_response_prepare.append(guard.add_headers)
        self._app.add_routes([route.registered() for route in routes])

    async def run(self) -> None:
        """Serves until cancelled. Tries again if the address cannot be used: lines are more
        important than the page."""
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
        loads = asyncio.create_task(self._loads.run(), name="loads")
        try:
            await self._load_certificate()
            server = await self._bound(runner)
            try:
                log.info("web page ready", at=self._config.url)
                while True:
                    await asyncio.sleep(RENEWED)
                    await self._renew()
            finally:
                server.close()
        finally:
            loads.cancel()
            await runner.cleanup()

    async def _load_certificate(self) -> None:
        if (tls := self._config.tls) is not None:
            self._context = await off_loop(exposure.context, tls, within=LOADED_WITHIN)

    async def _renew(self) -> None:
        try:
            await self._load_certificate()
        except GatewayError as error:
            log.warning("certificate not renewed", why=str(error))

    async def take_over(self, _config: Config, _renewed: Mapping[Tag, Tag]) -> None:
        """A reload looks at the certificate at once."""
        await self._renew()

    async def _bound(self, runner: web.AppRunner) -> asyncio.AbstractServer:
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
                if (why := error.strerror or str(error)) != logged:
                    log.error("web page not served", at=self._config.url, why=why)  # noqa: TRY400
                logged = why
                await asyncio.sleep(AGAIN)
                continue
            for bound in server.sockets:
                with suppress(OSError):
                    bound.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
            return server

    # -- probes and metrics --

    def _probes(self) -> list[Route]:
        return [
            Route(
                "/metrics",
                self._metrics,
                "Metrics for Prometheus",
                kind="text/plain",
                done="Metrics",
            ),
            Route(
                "/healthz",
                self._health,
                "The event loop turns",
                kind="text/plain",
                done="ok",
                is_open=True,
            ),
            Route(
                "/readyz",
                self._ready,
                "The gateway serves its plant",
                kind="text/plain",
                done="ready",
                errors={503: "It does not"},
                is_open=True,
            ),
        ]

    async def _health(self, _: web.Request) -> web.Response:
        """The event loop turns."""
        return web.Response(text="ok\n")

    async def _ready(self, _: web.Request) -> web.Response:
        if self._core.north.is_ready:
            return web.Response(text="ready\n")
        return web.Response(status=503, text="not ready: the gateway does not serve its plant\n")

    async def _metrics(self, _: web.Request) -> web.Response:
        documents = await self._core.north.documents(SCRAPE_AGE)
        ready = self._core.north.is_ready
        plant = self._core.plant

        def text() -> bytes:
            return metrics.exposition(documents, plant, ready=ready)

        body = await off_loop(text)
        return web.Response(body=body, headers={"Content-Type": metrics.CONTENT_TYPE})


def _page() -> list[Route]:
    """Returns the routes of the files of the page; `page.html` is at `/`."""
    return [
        _file(
            "/" if file.suffix == ".html" else f"/{file.name}",
            file.read_bytes(),
            _KINDS[file.suffix],
        )
        for file in sorted(_FOLDER.iterdir())
    ]


def _file(path: str, body: bytes, kind: str) -> Route:
    """Returns the route of a file: it holds no value, so it is open."""
    small = gzip.compress(body, mtime=0)

    async def asset(request: web.Request) -> web.Response:
        found = web.Response(body=body, content_type=kind, charset="utf-8")
        found.headers["Vary"] = "Accept-Encoding"
        if "gzip" in request.headers.get("Accept-Encoding", ""):
            found.body, found.headers["Content-Encoding"] = small, "gzip"
        return found

    return Route(path, asset, is_open=True)
