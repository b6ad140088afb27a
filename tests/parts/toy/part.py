"""The toy part: a document and a route with its greeting."""

import asyncio
from collections.abc import Mapping, Sequence

from aiohttp import web

from gateway.plant.part import Core, Kind, Part, Phase
from tests.parts.toy.settings import ToySection


class Toy:
    def __init__(self, settings: ToySection) -> None:
        self._greeting = settings.greeting

    async def run(self) -> None:
        await asyncio.Event().wait()

    def documents(self) -> Mapping[str, Mapping[str, object]]:
        return {"toy": {"greeting": self._greeting}}

    def routes(self) -> Sequence[web.RouteDef]:
        return [web.get("/api/toy", self._answer)]

    async def _answer(self, _request: web.Request) -> web.Response:
        return web.json_response({"greeting": self._greeting})


def _make(core: Core) -> Part | None:
    settings = core.config.part(ToySection)
    return None if settings is None else Toy(settings)


KIND = Kind(_make, Phase.SHOWING)
