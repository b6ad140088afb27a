"""Alarms in the JSON API: the list, and the acknowledgement with a token."""

import asyncio
from functools import partial

from aiohttp import web

from gateway.contract import payload
from gateway.contract.interfaces import North
from gateway.contract.problems import Failure, Problem
from gateway.errors import BadValue, GatewayError
from gateway.parts.web.connections import Places
from gateway.parts.web.guard import BY
from gateway.parts.web.routes import LIMIT, Choice, Route, Word, answer, body, json_off_loop, raw
from gateway.parts.web.schemas import ref
from gateway.plant.part import Core, Listed

PAST_WAITING = 16, 4  # queries of the past at once and waiting, and of one client

_STATE = Choice(
    "state",
    "open, if left out: all that are not normal; suppressed: shelved or out of service; all; or "
    "one state",
    ("open", "suppressed", "all", "normal", "active", "acknowledged", "returned"),
)
_AFTER = Word("after", "Last alarm of the page before")
_TIME = Word("time", "A range as in a query of Zenoh: [now(-1d)..], if left out")
_NONE = "the alarms do not work now: see `faults` of /api/status"
_ALARM = Word("alarm", "device/tag, device, or line:name", required=True)
_ORDERS = (
    (
        "/api/alarms/acknowledge",
        "Acknowledges one alarm for an operator; a repeat gets the same answer",
    ),
    ("/api/alarms/order", "Shelves one alarm, takes it out of service, or puts it back: `do`"),
)
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
        self._places = Places(*PAST_WAITING, "queries of past alarms")
        self._turn = asyncio.Semaphore()

    def routes(self) -> list[Route]:
        return [
            Route(
                "/api/alarms",
                self._alarms,
                "Alarms, those without acknowledgement first, in pages",
                parameters=(_STATE, _AFTER, LIMIT),
                reply=ref("Alarms"),
                errors={400: "A wrong state or limit"},
            ),
            Route(
                "/api/alarms/past",
                self._past,
                "Changes of alarms, the newest first",
                parameters=(_TIME, LIMIT),
                reply=ref("PastAlarms"),
                errors={400: "A wrong time or limit", 503: "No history, or it cannot be read"},
            ),
            *(
                Route(
                    path,
                    self._order,
                    about,
                    method="post",
                    parameters=(_ALARM,),
                    body=ref("AcknowledgeRequest"),
                    reply=ref("AlarmDocument"),
                    done="It is done, and on disk",
                    errors={
                        403: "No token",
                        408: "The body did not arrive",
                        415: "No application/json",
                    },
                    failures={
                        400: "bad-value: no name of an operator, no reason or no end",
                        404: "unknown-tag: no such alarm",
                        409: "nothing-to-acknowledge: it is normal, or was raised again",
                        503: "busy: this gateway is the standby, or stood still",
                    },
                )
                for path, about in _ORDERS
            ),
        ]

    async def _alarms(self, request: web.Request) -> web.Response:
        """Without `state` all that are not normal; `state=all` returns those too."""
        most, after, state = LIMIT.of(request), _AFTER.of(request), _STATE.of(request) or "open"
        lists = self._others.each(Listed)
        if not lists:
            return answer(503, _NONE)
        try:
            return await json_off_loop(partial(lists[0].page, state, after, most))
        except BadValue as error:
            return answer(400, str(error))

    async def _past(self, request: web.Request) -> web.Response:
        most, time_range = LIMIT.of(request), _TIME.of(request) or "[now(-1d)..]"
        lists = self._others.each(Listed)
        if not lists:
            return answer(503, _NONE)
        with self._places.taken(request.transport):
            async with self._turn:
                try:
                    return await json_off_loop(lambda: {"alarms": lists[0].past(time_range, most)})
                except BadValue as error:
                    return answer(400, str(error))
                except GatewayError as error:
                    return answer(503, str(error) or "this gateway keeps no history")

    async def _order(self, request: web.Request) -> web.Response:
        return await ordered(self._north, request, "alarms", _ALARM.of(request) or "")


async def ordered(north: North, request: web.Request, part: str, name: str) -> web.Response:
    """Has a part carry out the order in the body of a request, about `name`."""
    arrived = asyncio.get_running_loop().time()
    if request.content_type != "application/json":
        return answer(415, "send the order as Content-Type: application/json")
    data = await body(request)
    result = await north.order(part, name, data, f"web {request[BY]}", arrived)
    if isinstance(result, Failure):
        return raw(payload.outcome(result), _STATUS.get(result.problem, 503))
    return raw(result)
