"""Alarms in the JSON API: the list, and the acknowledgement with a token."""

import asyncio
from collections.abc import Mapping
from itertools import islice
from typing import Any

from aiohttp import web

from gateway.contract import payload
from gateway.contract.payload import Failure, Problem
from gateway.northbound.alarms import alarm_fields, open_alarms
from gateway.parts.alarms import Entry, State
from gateway.parts.web.guard import BY
from gateway.parts.web.replies import answer, body, json_off_loop, raw
from gateway.parts.web.routes import LIMIT, Choice, Route, Word
from gateway.parts.web.schemas import ref
from gateway.parts.web.sources import Sources

MOST_SHOWN = 50  # on the status page
_STATE = Choice(
    "state",
    "open, if left out: all that are not normal; all; or one state",
    ("open", "all", *(state.value for state in State)),
)
_AFTER = Word("after", "Last alarm of the page before")
_ALARM = Word("alarm", "device/tag, device, or line:name", required=True)
_STATUS = {
    Problem.BAD_VALUE: 400,
    Problem.NOT_ALLOWED: 403,
    Problem.UNKNOWN_TAG: 404,
    Problem.NOTHING_TO_ACKNOWLEDGE: 409,
}


class AlarmApi:
    """The handlers."""

    def __init__(self, sources: Sources) -> None:
        self._plant = sources.plant
        self._north = sources.north

    def routes(self) -> list[Route]:
        return [
            Route(
                path="/api/alarms",
                handler=self._alarms,
                name="alarms",
                about="Alarms, those without acknowledgement first, in pages",
                parameters=(_STATE, _AFTER, LIMIT),
                reply=ref("Alarms"),
                errors={400: "A wrong state or limit"},
            ),
            Route(
                path="/api/alarms/acknowledge",
                handler=self._acknowledge,
                name="acknowledge",
                about="Acknowledges one alarm for an operator; a repeat gets the same answer",
                method="post",
                parameters=(_ALARM,),
                body=ref("Acknowledgement"),
                reply=ref("Alarm"),
                done="It is acknowledged",
                errors={
                    403: "No token",
                    408: "The body did not arrive",
                    415: "No application/json",
                },
                failures={
                    400: "bad-value: no name of an operator",
                    404: "unknown-tag: no such alarm",
                    409: "nothing-to-acknowledge: it is normal, or was raised again",
                    503: "busy: this gateway is the standby, or stood still",
                },
            ),
        ]

    async def _alarms(self, request: web.Request) -> web.Response:
        """Without `state` all that are not normal; `state=all` returns those too."""
        most, after, state = LIMIT.of(request), _AFTER.of(request), _STATE.of(request)

        def page() -> object:
            found = self._select(state)
            if after is not None:
                keys = [entry.key for entry in found]
                found = found[keys.index(after) + 1 :] if after in keys else []
            shown = [alarm_fields(one, self._plant.sample) for one in islice(found, most)]
            more = len(found) > most
            return {
                "alarms": shown,
                "counts": self._plant.alarms.counts(),
                "next": found[most - 1].key if more else None,
            }

        return await json_off_loop(page)

    def _select(self, state: str) -> list[Entry]:
        if state == "open":
            return open_alarms(self._plant)
        entries = list(self._plant.alarms.entries.values())
        return [one for one in entries if state in ("all", one.status.state.value)]

    async def _acknowledge(self, request: web.Request) -> web.Response:
        arrived = asyncio.get_running_loop().time()
        if request.content_type != "application/json":
            return answer(415, "send the operator's name as Content-Type: application/json")
        name, data = _ALARM.of(request) or "", await body(request)
        result = self._north.acknowledge(name, data, f"web {request[BY]}", arrived)
        if isinstance(result, Failure):
            return raw(payload.outcome(result), _STATUS.get(result.problem, 503))
        return raw(result)


def alarms_shown(sources: Sources) -> Mapping[str, Any]:
    """Returns the counts, and the first alarms that are not normal."""
    found = open_alarms(sources.plant)
    shown = [alarm_fields(entry, sources.plant.sample) for entry in found[:MOST_SHOWN]]
    return {"shown": shown, "more": max(0, len(found) - MOST_SHOWN)}
