"""The toy part: a document and a route with its greeting, and a fault when it was greeted."""

import asyncio
from collections.abc import Mapping, Sequence

from aiohttp import web
from typing_extensions import TypedDict

from gateway.contract.documents.catalogue import in_status
from gateway.contract.line_faults import Fault
from gateway.plant.part import Core, Kind, Part, Phase
from tests.parts.toy.settings import ToySection


class ToyDocument(TypedDict):
    greeting: str


class Toy:
    def __init__(self, settings: ToySection) -> None:
        self._greeting = settings.greeting
        self._greeted = False

    async def run(self) -> None:
        await asyncio.Event().wait()

    def documents(self) -> Mapping[str, ToyDocument]:
        return {"toy": {"greeting": self._greeting}}

    def faults(self) -> Sequence[Fault]:
        return [Fault("toy", "the toy was greeted")] if self._greeted else []

    def routes(self) -> Sequence[web.RouteDef]:
        return [web.get("/api/toy", self._answer)]

    async def _answer(self, _request: web.Request) -> web.Response:
        self._greeted = True
        return web.json_response({"greeting": self._greeting})


def _make(core: Core) -> Part | None:
    settings = core.config.part(ToySection)
    return None if settings is None else Toy(settings)


KIND = Kind(_make, Phase.SHOWING, documents=(in_status("toy", ToyDocument),))
