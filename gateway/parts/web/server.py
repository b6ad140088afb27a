"""The HTTP side of one gateway: every route of the page, the JSON API, probes and metrics.

Whatever its clients do, the lines go on: connections and requests are limited, slow clients are
dropped, and answers of a large plant are made on threads.
"""

import asyncio
import json
from collections.abc import Mapping
from pathlib import Path

from aiohttp import web

from gateway.config import Config
from gateway.parts.web import metrics, openapi
from gateway.parts.web.alarms import AlarmApi
from gateway.parts.web.api import Api
from gateway.parts.web.connections import Connections
from gateway.parts.web.events import Events
from gateway.parts.web.fleet import api as fleet
from gateway.parts.web.fleet.api import FleetApi, with_fleet
from gateway.parts.web.guard import Guard
from gateway.parts.web.languages import catalogue_route
from gateway.parts.web.line_past import Loads
from gateway.parts.web.listener import Listener, file_route, files_of
from gateway.parts.web.routes import Route
from gateway.parts.web.settings import WebSection
from gateway.parts.web.tag_list import TagList
from gateway.plant.part import Core, Routed
from gateway.plant.threads import off_loop
from gateway.tags import Tag

SCRAPE_AGE = 1.0  # seconds that the state in the metrics may be old
ASSETS = Path(__file__).parent / "assets"


class Server:
    """The HTTP side of one gateway. Raises `ConfigError` for a bad tokens file."""

    def __init__(self, config: WebSection, core: Core) -> None:
        self._core = core
        tags = TagList(core.plant, config.overview)
        self._api = Api(core, tags)
        self._loads = Loads(core)
        connections = Connections()
        guard = Guard(config, connections)
        events = Events(core, tags, self._loads, guard.who, self._api.past)
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
            *files_of(ASSETS, "page.html"),
            catalogue_route("page", config.language),
        ]
        if config.fleet is not False:
            page = with_fleet((ASSETS / "page.html").read_bytes())
            routes = [one for one in routes if one.path != "/"]
            routes += [file_route("/", page, "text/html"), *files_of(fleet.ASSETS, "")]
            folder = config.fleet if isinstance(config.fleet, Path) else None
            routes += FleetApi(core, folder).routes()
        self.description = openapi.document(routes)
        text = json.dumps(self.description, indent=2).encode()
        routes.append(file_route("/openapi.json", text, "application/json"))
        self._listener = Listener(config, guard, connections, routes)

    async def run(self) -> None:
        """Serves until cancelled."""
        loads = asyncio.create_task(self._loads.run(), name="loads")
        try:
            await self._listener.run()
        finally:
            loads.cancel()

    async def take_over(self, _config: Config, _renewed: Mapping[Tag, Tag]) -> None:
        """A reload looks at the certificate at once."""
        await self._listener.renew()

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
