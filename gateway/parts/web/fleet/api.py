"""Asks all gateways under the prefix for their reports while a client looks."""

import asyncio
import gzip
import time
from pathlib import Path

from aiohttp import web

from gateway.contract import payload
from gateway.contract.fleet_rows import rows, told_by
from gateway.errors import GatewayError
from gateway.parts.web.fleet.files import FleetFiles
from gateway.parts.web.routes import Route, answer, raw
from gateway.parts.web.schemas import ref
from gateway.plant.part import Core
from gateway.plant.threads import off_loop
from gateway.tags.timestamps import rfc3339

ASSETS = Path(__file__).parent / "assets"
ASK_EVERY = 5.0  # seconds: all clients together ask no more often
MOST_GATEWAYS = 10_000  # that replied once, and are missed when they do not
_PAGE = b'<script src="page.js"'  # it looks for the views: ours is there before
_OURS = (
    b'<link rel="stylesheet" href="fleet.css">\n<script src="fleet.js" type="module"></script>\n'
)


class FleetApi:
    """The handler. One query at a time. Keeps who replied until the gateway ends. `folder`: the
    files of the gateways, or None."""

    def __init__(self, core: Core, folder: Path | None) -> None:
        self._north = core.north
        self._files = None if folder is None else FleetFiles(folder, core.config.zenoh.prefix)
        self._seen: dict[str, str] = {}
        self._asking = asyncio.Lock()
        self._asked_at = float("-inf")
        self._found = b""

    def routes(self) -> list[Route]:
        return [
            Route(
                "/api/fleet",
                self._fleet,
                "All gateways under the prefix, the worst first: see docs/fleet.md",
                reply=ref("Fleet"),
                errors={503: "Zenoh is not ready"},
            )
        ]

    async def _fleet(self, request: web.Request) -> web.Response:
        loop = asyncio.get_running_loop()
        try:
            async with self._asking:
                if loop.time() - self._asked_at >= ASK_EVERY:
                    if self._files is not None:
                        await self._files.look()
                    self._found = await off_loop(self._ask)
                    self._asked_at = loop.time()
        except GatewayError as error:
            return answer(503, str(error))
        if "gzip" not in request.headers.get("Accept-Encoding", ""):
            return raw(await off_loop(gzip.decompress, self._found))
        found = raw(self._found)
        found.headers["Content-Encoding"] = "gzip"
        return found

    def _ask(self) -> bytes:
        """Returns the answer, compressed: 1,000 gateways are 0.7 MB of text. Blocks."""
        asked = time.time()
        told, mistakes = told_by(self._north.reports(), asked)
        self._seen |= {name: one.report["time"] for name, one in told.items()}
        for name in [*self._seen][:-MOST_GATEWAYS]:
            del self._seen[name]
        wanted, more = (None, ()) if self._files is None else self._files.found
        document = {
            "time": rfc3339(int(asked * 1e9)),
            "took": round(time.time() - asked, 3),
            "gateways": [row.document() for row in rows(told, wanted, self._seen)],
            "mistakes": [*mistakes, *more][:100],
        }
        return gzip.compress(payload.document(document), 1)


def with_fleet(page: bytes) -> bytes:
    """Returns the page with the view of the fleet."""
    return page.replace(_PAGE, _OURS + _PAGE, 1)
