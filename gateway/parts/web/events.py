"""Server-sent events for the status page: state, chosen values, exchanges of one line.

A client that comes again gets the samples since its last event from the history. Nothing else is
queued for a client. Each event is made from the current state when the client has taken
the one before, so a slow client gets fewer events, and none that is old. A client that takes
nothing for `SLOW` seconds is dropped.
"""

import asyncio
import time
from collections import ChainMap
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import orjson
from aiohttp import web

from gateway.contract import payload
from gateway.contract.faults import Documents, below, causes, transfers
from gateway.errors import GatewayError
from gateway.parts.web.api import overview
from gateway.parts.web.connections import Places, Who
from gateway.parts.web.line_past import Loads
from gateway.parts.web.routes import Route, Word, drop
from gateway.parts.web.tag_list import TagList
from gateway.parts.web.wire import Recorder, Wires, as_fields
from gateway.plant.part import Core, Shown
from gateway.plant.threads import off_loop
from gateway.tags import Sample, Tag
from gateway.tags.timestamps import rfc3339

MOST_PAGES = 20  # and of one client
MOST_PAGES_OF_CLIENT = 16
SLOW = 5.0  # seconds
WIRE_EVERY = 0.25  # seconds between two events with exchanges
VALUES_EVERY = 1.0
STATE_EVERY = 2.0
OVERLAP = 1.0  # seconds before an event that are replayed after it, too
MOST_MISSED = 1_000  # samples of one tag that are replayed
MOST_DIGITS = 14  # of an id: ms since 1970
# Of a request, a tag, the parameters of `/api/history` and a limit.
Past = Callable[[web.Request, Tag, Mapping[str, str], int], Awaitable[dict[str, object] | None]]
_BY_NAME = ("devices", "transfers", "timelines")  # of the state: a page gets their changes
MOST_SENTENCES = 50  # about what is wrong, and about what to look at
_LINE = Word("line", "With the exchanges of this line")
_CHOSEN = Word("tags", "With these values: keys with commas; left out: those of the overview")


class Events:
    """The handler of `/api/events`."""

    def __init__(
        self,
        core: Core,
        tags: TagList,
        loads: Loads,
        who: Callable[[web.Request], Who | None],
        past: Past,
    ) -> None:
        """`who`: the client; None when its token was withdrawn. `past`: of `Api`."""
        self._past = past
        self._core = core
        self._tags = tags
        self.loads = loads
        self._who = who
        self.wires = Wires(core.plant)
        self._pages = Places(MOST_PAGES, MOST_PAGES_OF_CLIENT, "pages")
        self._state: tuple[Documents, dict[str, Any]] = ({}, {})

    def routes(self) -> list[Route]:
        return [
            Route(
                "/api/events",
                self.handle,
                "Server-sent events: `values`, as docs/page.md has them; others may change",
                parameters=(_LINE, _CHOSEN),
                kind="text/event-stream",
                done="Events",
            )
        ]

    def state(self, documents: Documents) -> dict[str, Any]:
        """Returns the state as all pages get it; made once for the same documents."""
        if self._state[0] is not documents:
            shown = ChainMap(*[part.shown() for part in self._core.others.each(Shown)])
            timelines = {"timelines": {**self.loads.timelines}}
            self._state = documents, {**_state(documents), **timelines, **shown}
        return self._state[1]

    async def handle(self, request: web.Request) -> web.StreamResponse:
        tags = await off_loop(self._tags.chosen, _CHOSEN.of(request))
        with (
            self._pages.taken(request.transport),
            self.wires.watched(_LINE.of(request) or "") as recorder,
        ):
            response = web.StreamResponse(headers={"Content-Type": "text/event-stream"})
            response.headers["X-Accel-Buffering"] = "no"  # a proxy passes events on at once
            await response.prepare(request)
            async for event in self._missed(request, tags):
                await response.write(event)
            page = Page(self._core, self, tags, recorder)
            await _send(request, response, page, self._who)
        return response

    async def _missed(self, request: web.Request, tags: Sequence[Tag]) -> AsyncIterator[bytes]:
        """Yields what the history has since the last event of a client that comes again."""
        last = request.headers.get("Last-Event-ID", "")
        if not (last.isascii() and last.isdigit() and len(last) <= MOST_DIGITS):
            return
        since = {"time": f"[{rfc3339(int(last) * 10**6)}..]"}
        for tag in tags:
            try:
                found = await self._past(request, tag, since, MOST_MISSED)
            except (GatewayError, web.HTTPServiceUnavailable) as error:
                found = {"tag": tag.key, "error": str(error)}
            if found is not None:
                yield _event("missed", found)


async def _send(
    request: web.Request,
    response: web.StreamResponse,
    page: "Page",
    who: Callable[[web.Request], Who | None],
) -> None:
    """Sends until the client leaves, takes nothing, or has no valid token any more."""
    while (client := who(request)) is not None:
        data = await page.next(client)
        try:
            async with asyncio.timeout(SLOW):
                await response.write(data)
        except (TimeoutError, ConnectionError):
            drop(request)
            return
        await asyncio.sleep(WIRE_EVERY if page.has_state else 0)


@dataclass(eq=False)
class Page:
    """The events of one client: notes what it has, and makes what it gets next."""

    _core: Core
    _events: Events
    _tags: Sequence[Tag]
    _recorder: Recorder | None
    _exchange: int = 0  # the number of the last one
    _load: int = 0  # the number of the last measurement
    _sent: dict[Tag, Sample] = field(default_factory=dict)
    _shown: Mapping[str, Mapping[str, object]] = field(default_factory=dict)  # by `_BY_NAME`
    _values_due: float = 0.0
    _state_due: float = 0.0

    @property
    def has_state(self) -> bool:
        return self._state_due > 0

    async def next(self, client: Who) -> bytes:
        """Returns the events that are due; at least the time. The first values do not wait for the
        state, which may take a while on a busy machine."""
        loop = asyncio.get_running_loop()
        events = []
        if self._values_due and self._state_due <= loop.time():
            documents = await self._core.north.documents(STATE_EVERY)
            self._state_due = loop.time() + STATE_EVERY
            events.append(_event("state", self._state(documents, client)))
            loads = self._events.loads
            if self._load < loads.number:
                events.append(_event("loads", loads.since(self._load)))
                self._load = loads.number
        if self._values_due <= loop.time():
            self._values_due = loop.time() + VALUES_EVERY
            number = int((time.time() - OVERLAP) * 1000)
            events.append(_event("values", self._values(self._tags), number))
        if self._recorder is not None and (new := self._recorder.since(self._exchange)):
            missed = new[0].number - self._exchange - 1 if self._exchange else 0
            self._exchange = new[-1].number
            exchanges = [as_fields(exchange) for exchange in new]
            events.append(_event("wire", {"missed": missed, "exchanges": exchanges}))
        # The second one is steady: the page finds out by it that events are late.
        events.append(_event("time", [round(time.time() * 1000), round(loop.time() * 1000)]))
        return b"".join(events)

    def _state(self, documents: Documents, client: Who) -> dict[str, Any]:
        whole = self._events.state(documents)
        changed = {name: _changes(self._shown.get(name, {}), whole[name]) for name in _BY_NAME}
        self._shown = {name: whole[name] for name in _BY_NAME}
        return {**whole, "ready": self._core.north.is_ready, "you": [*client], **changed}

    def _values(self, tags: Sequence[Tag]) -> list[list[object]]:
        """Returns the values that changed, or were read again: the text of the value as in JSON,
        because a browser rounds large integers."""
        found = []
        for tag in tags:
            sample = self._core.plant.sample(tag)
            if self._sent.get(tag) == sample:
                continue
            self._sent[tag] = sample
            fields = payload.sample_fields(sample)
            known = fields["value"]
            text = known if isinstance(known, str) else orjson.dumps(known).decode()
            why: str = fields.get("origin") or ""
            if end := fields.get("limited"):
                why = f"{why} limited {end}".strip()
            if fields["quality"] != "good":
                why = " ".join(filter(None, (fields["reason"], fields.get("detail"), why)))
            text, at = "" if known is None else text, sample.time // 10**6
            found.append([tag.key, text, fields["quality"], at, why, fields.get("text")])
        return found


def _state(documents: Documents) -> dict[str, Any]:
    known, why = overview(documents), causes(documents)
    line_of = {name: line for line, one in below("lines/", documents) for name in one["devices"]}
    return {
        **{name: known["status"][name] for name in ("name", "version", "up", "tags")},
        "origins": {
            name: word for word in ("simulated", "replayed") for name in known["status"][word]
        },
        "links": known["zenoh"]["to"],
        "history": known.get("history", {}).get("state"),
        "standby": known.get("standby", {}).get("stand"),
        **{name: known[name][:MOST_SENTENCES] for name in ("faults", "warnings")},
        "more": sum(max(0, len(known[name]) - MOST_SENTENCES) for name in ("faults", "warnings")),
        "lines": [
            [
                *(name, one["open"], one["trouble"], one["expected"]["load"]),
                *(one["measured"]["requests_per_second"], *why[name]),
            ]
            for name, one in below("lines/", documents)
        ],
        "doors": [
            [name, one["line"], one["share"], [[of["address"], of["since"]] for of in programs]]
            for name, one in below("doors/", documents)
            if (programs := one["programs"])
        ],
        "calls": _calls(documents),
        "transfers": {number: _transfer(one) for number, one in transfers(documents)},
        "devices": {
            name: [line_of.get(name, ""), one["standing"], one["diagnosis"]]
            for name, one in below("devices/", documents)
        },
    }


def _calls(documents: Documents) -> list[list[object]]:
    """Returns the lines with a modem."""
    fields = ("state", "since", "next", "last_result", "made", "failed")
    return [
        [name, *(calls[field] for field in fields)]
        for name, one in below("lines/", documents)
        if (calls := one.get("calls"))
    ]


def _transfer(one: Mapping[str, Any]) -> list[object]:
    """Returns what the page shows of a row: it changes only when something happens."""
    code = "" if one["code"] is None else f"{one['code']}: {one['meaning']}"
    works = one["state"] == "carried"
    why = "" if works else one["why"]
    return [one["from"], one["to"], one["state"], code, one["time"], why]


def _changes(known: Mapping[str, object], now: Mapping[str, object]) -> dict[str, object]:
    """Returns what a page has to take over; None: it is gone."""
    changed = {name: one for name, one in now.items() if known.get(name) != one}
    return changed | dict.fromkeys(known.keys() - now.keys())


def _event(kind: str, data: object, number: int | None = None) -> bytes:
    after = b"" if number is None else b"id: %d\n" % number
    return b"event: %b\ndata: %b\n%b\n" % (kind.encode(), payload.document(data), after)
