"""Alarms in the JSON API: the list, and the acknowledgement with a token."""

import asyncio
from functools import partial

from aiohttp import web

from gateway.contract import payload
from gateway.contract.payload import Failure, Problem
from gateway.errors import BadValue
from gateway.parts.web.guard import BY
from gateway.parts.web.replies import answer, body, json_off_loop, limit, raw
from gateway.plant.part import Core, Listed

MOST_ITEMS = 1000  # of one page
_ITEMS = 200
_STATUS = {
    Problem.BAD_VALUE: 400,
    Problem.NOT_ALLOWED: 403,
    Problem.UNKNOWN_TAG: 404,
    Problem.NOTHING_TO_ACKNOWLEDGE: 409,
}


class AlarmApi:
    """The handlers."""

    def __init__(self, core: Core) -> None:
        self._north = core.north
        self._others = core.others

    def routes(self) -> list[web.RouteDef]:
        return [
            web.get("/api/alarms", self._alarms),
            web.post("/api/alarms/acknowledge", self._acknowledge),
        ]

    async def _alarms(self, request: web.Request) -> web.Response:
        """Without `state` all that are not normal; `state=all` returns those too."""
        most, after = limit(request, _ITEMS, MOST_ITEMS), request.query.get("after")
        state = request.query.get("state", "open")
        lists = self._others.each(Listed)
        if not lists:
            return answer(503, "the alarms do not work now: see `faults` of /api/status")
        try:
            return await json_off_loop(partial(lists[0].page, state, after, most))
        except BadValue as error:
            return answer(400, str(error))

    async def _acknowledge(self, request: web.Request) -> web.Response:
        arrived = asyncio.get_running_loop().time()
        if request.content_type != "application/json":
            return answer(415, "send the operator's name as Content-Type: application/json")
        name, data = request.query.get("alarm", ""), await body(request)
        result = await self._north.order("alarms", name, data, f"web {request[BY]}", arrived)
        if isinstance(result, Failure):
            return raw(payload.outcome(result), _STATUS.get(result.problem, 503))
        return raw(result)
