"""The JSON API: tags, devices, lines, history, writes.

Lists come in pages: `limit` items, and `next` for the parameter `after` of the next page. Answers
are made on threads, because those of a large plant take long.
"""

import asyncio
import time
from collections.abc import Mapping
from functools import partial
from typing import Any

from aiohttp import web

from gateway.contract import payload
from gateway.contract.faults import Documents, below, coded_faults, coded_warnings, transfers
from gateway.contract.interfaces import History
from gateway.contract.past import buckets
from gateway.contract.past import samples as past
from gateway.contract.past.buckets import Now
from gateway.contract.past.history_query import question
from gateway.contract.problems import Problem
from gateway.errors import BadValue, Busy, GatewayError
from gateway.parts.web.alarms import ordered
from gateway.parts.web.connections import Places
from gateway.parts.web.guard import BY
from gateway.parts.web.routes import (
    LIMIT,
    Choice,
    Count,
    Route,
    Word,
    answer,
    as_json,
    body,
    json_off_loop,
    raw,
)
from gateway.parts.web.schemas import ref
from gateway.parts.web.tag_list import TagList
from gateway.plant.part import Core
from gateway.plant.threads import off_loop
from gateway.tags import Tag
from gateway.tags.sample import has_value

STATE_AGE = 2.0  # seconds that the state of lines and devices may be old
MOST_SAMPLES = 10_000
HISTORY_WITHIN = 20.0  # seconds for one query
HISTORY_AT_ONCE = 4  # queries; they read the disk
HISTORY_WAITING = 16  # queries at once and waiting, and of one client; beyond, 503
HISTORY_OF_CLIENT = 12
# 200 only for an acknowledged write. 502 and above: it was sent, or the device cannot be reached.
_STATUS = {
    Problem.BAD_VALUE: 400,
    Problem.NOT_WRITABLE: 403,
    Problem.NOT_ALLOWED: 403,
    Problem.UNKNOWN_TAG: 404,
    Problem.REFUSED: 502,
    Problem.LINE_DOWN: 503,
    Problem.NO_REPLY: 503,
    Problem.BUSY: 503,
    Problem.UNCLEAR: 504,
    Problem.INCOMPLETE: 502,
}
_SAMPLES = Count("limit", "Items of this page, 1000 if left out", 1, MOST_SAMPLES, 1000)
_AFTER_TRANSFER = Count("after", "Number of the last transfer of the page before", 0, 10**8, 0)
_AFTER_DEVICE = Word("after", "Name of the last device of the page before")
_AFTER_TAG = Word("after", "Last tag of the page before")
_OF_LINE = Word("line", "Only devices of this line")
_OF_DEVICE = Word("device", "Only tags of this device")
_FIND = Word("find", "Only tags with all these words in their key or description")
_CHOSEN = Word("tags", "Only these: keys with commas, also with *; empty: those of the overview")
_SKIP = Count("skip", "So many tags are left out before the page", 0, 10**8, 0)
_TAG = Word("tag", "device/name", required=True)
_WRITTEN = Word("tag", "device/name; or a device, to write several of its tags", required=True)
_DOOR = Word("door", "Name of the door", required=True)
# `question` parses them, as for Zenoh.
_QUESTION = (
    Word("time", "A time range of Zenoh; [now(-1h)..] if left out: see docs/history.md"),
    _SAMPLES,
    Word("bucket", "Length of a bucket such as 1min: see docs/charts.md"),
    Word("agg", "Values of each bucket: min,max,mean,last if left out"),
    Choice("align", "start: the first bucket begins with the range", ("utc", "start")),
    Count("last", "The newest samples of the range", 1, MOST_SAMPLES),
    Choice("quality", "good leaves out samples and buckets that are not good", ("any", "good")),
)


class Api:
    """The handlers."""

    def __init__(self, core: Core, tags: TagList) -> None:
        self._plant = core.plant
        self._north = core.north
        self._core = core
        self._list = tags
        self._history_turns = asyncio.Semaphore(HISTORY_AT_ONCE)
        self._history_places = Places(HISTORY_WAITING, HISTORY_OF_CLIENT, "queries of history")

    def routes(self) -> list[Route]:
        return [
            Route(
                "/api/status",
                self._status,
                "State of the gateway, and what is wrong",
                reply=ref("Status"),
            ),
            Route("/api/lines", self._lines, "All lines", reply=ref("Lines")),
            Route(
                "/api/transfers",
                self._transfers,
                "Transfers by number, in pages",
                parameters=(_AFTER_TRANSFER, LIMIT),
                reply=ref("Transfers"),
                errors={400: "A wrong number or limit"},
            ),
            Route(
                "/api/devices",
                self._device_page,
                "Devices by name, in pages",
                parameters=(_OF_LINE, _AFTER_DEVICE, LIMIT),
                reply=ref("Devices"),
                errors={400: "A wrong limit"},
            ),
            Route(
                "/api/devices/{device}",
                self._device,
                "One device with its requests",
                reply=ref("DeviceDocument"),
                errors={404: "No such device"},
            ),
            Route(
                "/api/tags",
                self._tags,
                "Tags with their values, in pages, in the order of the file",
                parameters=(_OF_DEVICE, _FIND, _CHOSEN, _AFTER_TAG, _SKIP, LIMIT),
                reply=ref("Tags"),
                errors={400: "A wrong limit", 404: "No such device"},
            ),
            Route(
                "/api/history",
                self._samples,
                "Recorded samples of one tag in the order of time, or buckets of time for a chart",
                parameters=(_TAG, *_QUESTION),
                reply=ref("History"),
                errors={
                    400: "A wrong time range, limit or bucket",
                    404: "No such tag, or no history of it",
                },
            ),
            Route(
                "/api/doors/release",
                self._door,
                "Disconnects the programs of a door; a raw door takes none for a minute",
                method="post",
                parameters=(_DOOR,),
                body=ref("DoorRequest"),
                reply=ref("DoorDocument"),
                done="The programs are disconnected",
                errors={403: "No token", 415: "No application/json"},
                failures={
                    400: "bad-value: another order",
                    404: "unknown-tag: no such door",
                    503: "busy: this gateway is the standby, or has no doors",
                },
            ),
            Route(
                "/api/write",
                self._write,
                "Writes one tag, or several of a device; answered when the device has acknowledged",
                method="post",
                parameters=(_WRITTEN,),
                body={"description": 'The value, as 12.5, true, [1, 2]; or {"value": 12.5}'},
                reply={"anyOf": [ref("WrittenDocument"), ref("GroupDocument")]},
                done="The device acknowledged",
                errors={408: "The body did not arrive", 415: "No application/json"},
                failures={
                    400: "bad-value: nothing was sent",
                    403: "not-writable, or no token",
                    404: "unknown-tag: nothing was sent",
                    502: "refused by the device; incomplete: some of several tags were written",
                    503: "busy, line-down, no-reply: nothing was sent",
                    504: "unclear: it may or may not be done",
                },
            ),
        ]

    async def _door(self, request: web.Request) -> web.Response:
        return await ordered(self._north, request, "doors", _DOOR.of(request) or "")

    async def _status(self, _: web.Request) -> web.Response:
        return as_json(overview(await self._north.documents(STATE_AGE)))

    async def _lines(self, _: web.Request) -> web.Response:
        documents = await self._north.documents(STATE_AGE)
        return await json_off_loop(lambda: {"lines": dict(below("lines/", documents))})

    async def _transfers(self, request: web.Request) -> web.Response:
        limit, after = LIMIT.of(request), _AFTER_TRANSFER.of(request)
        documents = await self._north.documents(STATE_AGE)

        def page() -> object:
            found = [one for one in transfers(documents) if int(one[0]) > after]
            shown = [{"transfer": int(number), **one} for number, one in found[:limit]]
            return {"transfers": shown, "next": found[limit - 1][0] if found[limit:] else None}

        return await json_off_loop(page)

    async def _device_page(self, request: web.Request) -> web.Response:
        limit, after = LIMIT.of(request), _AFTER_DEVICE.of(request) or ""
        line = _OF_LINE.of(request)
        documents = await self._north.documents(STATE_AGE)

        def page() -> object:
            names = [name for name, _ in below("devices/", documents) if name > after]
            if line is not None:
                names = [name for name in names if name in _devices_of(line, documents)]
            shown = {name: _without_requests(documents, name) for name in names[:limit]}
            return {"devices": shown, "next": names[limit - 1] if len(names) > limit else None}

        return await json_off_loop(page)

    async def _device(self, request: web.Request) -> web.Response:
        documents = await self._north.documents(STATE_AGE)
        name = request.match_info["device"]
        if (document := documents.get(f"devices/{name}")) is None:
            return answer(404, f"there is no device {payload.short(name)}")
        return as_json(document)

    async def _tags(self, request: web.Request) -> web.Response:
        limit, skip, after = LIMIT.of(request), _SKIP.of(request), _AFTER_TAG.of(request)
        device, find = _OF_DEVICE.of(request), _FIND.of(request) or ""
        chosen, known = _CHOSEN.of(request), self._list
        if device is not None and not known.has_device(device):
            return answer(404, f"there is no device {payload.short(device)}")

        def page() -> object:
            if chosen is None:
                found = known.select(device, find, after)
            else:
                found = known.chosen(chosen or None)
            shown = [known.fields(tag) for tag in found[skip : skip + limit]]
            more = len(found) > skip + limit
            return {
                "tags": shown,
                "next": shown[-1]["tag"] if more else None,
                "total": len(found),
            }

        return await json_off_loop(page)

    async def _samples(self, request: web.Request) -> web.Response:
        key = _TAG.of(request) or ""
        tag = self._plant.tag(key)
        if tag is None:
            return answer(404, f"there is no tag {payload.short(key)}")
        try:
            found = await self.past(request, tag, dict(request.query), _SAMPLES.of(request))
        except GatewayError as error:
            return answer(400 if isinstance(error, BadValue) else 503, str(error))
        if found is None:
            return answer(404, f"no history is kept of {tag.key}: it needs `history: true`")
        return await json_off_loop(lambda: found)

    async def past(
        self, request: web.Request, tag: Tag, parameters: Mapping[str, str], limit: int
    ) -> dict[str, object] | None:
        """Returns samples or buckets of a tag; None if no history is kept of it. Raises
        `GatewayError`, and `HTTPServiceUnavailable` if too many wait."""
        history = self._core.history()
        if history is None or not tag.publishing.history:
            return None
        find = partial(_found, history, tag, parameters, limit)
        is_valid = has_value(self._plant.sample(tag))

        def read() -> dict[str, object] | GatewayError:
            try:
                return find(Now(time.time_ns(), is_valid=is_valid))
            except GatewayError as error:
                return error

        with self._history_places.taken(request.transport):
            async with self._history_turns:
                found = await off_loop(read)
        if isinstance(found, GatewayError):
            raise found
        return found

    async def _write(self, request: web.Request) -> web.Response:
        arrived = asyncio.get_running_loop().time()
        if request.content_type != "application/json":
            return answer(415, "send the value as Content-Type: application/json")
        key, data = _WRITTEN.of(request) or "", await body(request)
        # The server does not cancel this when the client leaves: the write may be on the wire.
        result = await self._north.write(key, data, f"web {request[BY]}", arrived)
        failed = payload.failed(result)
        status = 200 if failed is None else _STATUS.get(failed.problem, 500)
        return raw(payload.outcome(result), status)


def _found(
    history: History, tag: Tag, parameters: Mapping[str, str], limit: int, now: Now
) -> dict[str, object]:
    """Returns the samples or buckets of one tag. Raises `GatewayError`."""
    asked = question({"time": "[now(-1h)..]", **parameters}, time="time")
    until = time.monotonic() + HISTORY_WITHIN

    def pause() -> None:
        if time.monotonic() > until:
            raise Busy(f"this takes more than {HISTORY_WITHIN:g} s: ask for a shorter time")

    if asked.bucket is not None:
        whole = [
            buckets.fields(tag, bucket, asked.aggregates)
            for bucket in history.buckets(tag, asked, now, pause)
            if bucket.quality == "good" or not asked.only_good
        ]
        return {"tag": tag.key, "buckets": whole, "complete": True}
    most = asked.last or limit
    if most > MOST_SAMPLES:
        raise BadValue(f"last={asked.last} is no count from 1 to {MOST_SAMPLES}")
    samples = list[object]()
    for sample in past.samples(history, tag, asked, limit, now.time, pause):
        samples.append(payload.sample_fields(sample))
        pause()
    complete = asked.last is not None or len(samples) < limit
    return {"tag": tag.key, "samples": samples, "complete": complete}


def overview(documents: Documents) -> dict[str, Any]:
    """Returns the state of the gateway, and sentences about what is wrong, also with codes."""
    told = {"faults": [*coded_faults(documents)], "warnings": [*coded_warnings(documents)]}
    parts = ("status", "zenoh", "outcomes", "history", "standby", "alarms")
    return {
        **{name: documents[name] for name in parts if name in documents},
        **{name: [one.text for one in found] for name, found in told.items()},
        "coded": {name: [one._asdict() for one in found] for name, found in told.items()},
    }


def _devices_of(line: str, documents: Documents) -> Mapping[str, Any]:
    known: Mapping[str, Any] = documents.get(f"lines/{line}", {}).get("devices", {})
    return known


def _without_requests(documents: Documents, name: str) -> Mapping[str, Any]:
    document = documents[f"devices/{name}"]
    return {field: value for field, value in document.items() if field != "requests"}
