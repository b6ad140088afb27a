"""The values of a plant from Zenoh: shared by all bridges.

A value is good only while a gateway says so and the liveliness token of its device exists. When the
token goes, the values of the device turn bad here, because no gateway can say it any more. They
turn good again by values that arrive after the token has returned, never by older ones.
"""

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import suppress

import orjson
import zenoh

from gateway.bridges.documents import Known, bad, copied, described_by, parsed
from gateway.bridges.presence import Presence
from gateway.bridges.program import say
from gateway.bridges.requests import Inbox, Requests
from gateway.errors import GatewayError

QUERY_EVERY = 60.0  # seconds between two queries of all values without a known reason
RETRY_AFTER = 0.5  # seconds, doubled up to QUERY_EVERY while values are missing
SETTLE = 0.1  # seconds
PAGE = 10_000  # samples of the history
MOST_TEMPLATES = 20  # of one device


class RemotePlant:
    """All tags under a prefix. Keys are `device/tag`.

    Calls in the event loop `described(key, meta)` for every new or changed description, and then
    `changed(key, known)` for every new value; `arranged` with the templates of each device.
    """

    def __init__(
        self,
        session: zenoh.Session,
        prefix: str,
        described: Callable[[str, Known], None],
        changed: Callable[[str, Known], None],
        arranged: Callable[[Mapping[str, Sequence[str]]], None] | None = None,
    ) -> None:
        self.tags: dict[str, Known] = {}
        self.values: dict[str, Known] = {}
        self.requests = Requests(session, prefix)
        self._prefix = prefix
        self._described, self._changed, self._arranged = described, changed, arranged
        self._query_due, self._arrived = asyncio.Event(), asyncio.Event()
        self._presence = Presence()
        self._loaded: dict[str, object] = {}  # when each gateway took its file, by key
        self._live: set[str] = set()  # keys that changed after the last query began
        inbox = Inbox(self._query_due.set)  # a query instead of the lost values
        token = inbox.callback(self._token, always=True)
        live, own = session.liveliness(), f"{prefix}/@gateway/*"
        self._declared = [
            session.declare_subscriber(f"{prefix}/**", inbox.callback(self._sample)),
            session.declare_subscriber(f"{prefix}/*/@block", inbox.callback(self._block)),
            session.declare_subscriber(f"{own}/reload", inbox.callback(self._reloaded)),
            live.declare_subscriber(own, token, history=True),
            live.declare_subscriber(f"{own}/alive/*", token, history=True),
        ]

    @property
    def trusted(self) -> set[str]:
        """The devices that answer, and are described."""
        return self._presence.trusted

    def key(self, key: str) -> str:
        return key.removeprefix(f"{self._prefix}/")

    def _token(self, key: str, there: bool, _payload: bytes, _about: bytes) -> None:
        gateway, _, device = self.key(key).removeprefix("@gateway/").partition("/alive/")
        if device and there:
            self._presence.arrived(gateway, device)
        elif device:
            self._gone(gateway, device, "no-reply")  # the gateway tells the exact reason
        elif there:
            self._presence.gateways.add(gateway)
            say(f"gateway {gateway} is there")
        else:
            self._presence.gateways.discard(gateway)
            say(f"gateway {gateway} is gone")
            for lost in {key.partition("/")[0] for key in self.tags}:
                if self._presence.may_be_of(gateway, lost):
                    self._gone(gateway, lost, "no-gateway")
        self._query_due.set()
        if there:
            self._arrived.set()

    def _reloaded(self, key: str, _is_put: bool, payload: bytes, _about: bytes) -> None:
        """Queries all again after a gateway has taken a changed file."""
        with suppress(ValueError, KeyError, TypeError):
            loaded = orjson.loads(payload)["loaded"]
            if self._loaded.get(key, loaded) != loaded:
                self._query_due.set()
            self._loaded[key] = loaded

    def _gone(self, gateway: str, device: str, reason: str) -> None:
        if not self._presence.is_lost(gateway, device):
            return
        for key, known in list(self.values.items()):
            of_device = key.startswith(f"{device}/")
            if of_device and (known["quality"] != "bad" or reason == "no-gateway"):
                self._store(key, bad(reason))

    def _sample(self, key: str, is_put: bool, payload: bytes, about: bytes) -> None:
        key = self.key(key)
        if known := self.read(key, is_put, payload, about):
            self._live.add(key)
            self._take(key, known)

    def _block(self, key: str, is_put: bool, payload: bytes, _about: bytes) -> None:
        device = self.key(key).removesuffix("/@block")
        with suppress(ValueError, AttributeError):
            for tag, document in orjson.loads(payload).items():
                self._sample(f"{device}/{tag}", is_put, orjson.dumps(document), b"")

    def read(self, key: str, is_put: bool, payload: bytes, about: bytes) -> Known | None:
        """Reads a payload. None: no gateway has the tag."""
        if (meta := self.tags.get(key)) is None:
            return None
        return parsed(meta, is_put, payload, about)

    def _take(self, key: str, known: Known) -> None:
        # Without a token it may be from before the token went, or belong to a new description.
        if known["quality"] == "bad" or key.partition("/")[0] in self._presence.trusted:
            self._store(key, known)

    def _store(self, key: str, known: Known) -> None:
        if known != self.values.get(key):
            self.values[key] = known
            self._changed(key, known)

    async def follow(self) -> None:
        """Queries all tags and values after every change of gateways or devices, and regularly."""
        pause, may_hang = RETRY_AFTER, True
        while True:
            self._query_due.clear()
            self._arrived.clear()
            query = asyncio.create_task(self._query())
            arrived = asyncio.create_task(self._arrived.wait())
            # A query that was sent when the link went would wait for its time-out.
            waited = {query, arrived} if may_hang else {query}
            await asyncio.wait(waited, return_when=asyncio.FIRST_COMPLETED)
            arrived.cancel()
            may_hang = query.done()
            if not query.done():
                query.cancel()
                await asyncio.sleep(SETTLE)  # gateways and devices arrive together
                continue
            pause = QUERY_EVERY if query.result() else min(2 * pause, QUERY_EVERY)
            with suppress(TimeoutError):
                async with asyncio.timeout(pause):
                    await self._query_due.wait()
                pause = RETRY_AFTER

    async def _describe(self) -> None:
        """Queries the descriptions. A device that answered before is trusted then."""
        self._presence.asked()
        described = set()
        for reply in await self.requests.ask("**/@meta"):
            if (sample := reply.ok) is None:
                continue
            key = self.key(str(sample.key_expr)).removesuffix("/@meta")
            if (meta := described_by(key, sample.payload.to_bytes())) is None:
                continue
            described.add(key.partition("/")[0])
            if self.tags.get(key) != meta:
                self.tags[key] = meta
                self._described(key, meta)
                if key not in self.values:
                    self._store(key, bad("starting"))
        self._presence.described(described)
        if self._arranged is not None:
            self._arranged(await self._templates())

    async def _templates(self) -> dict[str, list[str]]:
        """Queries the templates of each device."""
        found: dict[str, list[str]] = {}
        for reply in await self.requests.ask("@gateway/*/@introspect"):
            with suppress(ValueError, LookupError, TypeError, AttributeError):  # another program's
                payload = orjson.loads(reply.ok.payload.to_bytes()) if reply.ok else {}
                for device, about in payload.get("devices", {}).items():
                    names = about["templates"][:MOST_TEMPLATES]
                    found[device] = [name for name in names if isinstance(name, str)]
        return found

    async def _query(self) -> bool:
        """Returns True if every tag of every device with a token was answered."""
        await self._describe()
        self._live.clear()
        replies = [reply.ok for reply in await self.requests.ask("**")]
        answered = {self.key(str(sample.key_expr)) for sample in replies if sample is not None}
        for sample in replies:
            key = "" if sample is None else self.key(str(sample.key_expr))
            # A value that arrived by itself meanwhile may be newer.
            if sample and key not in self._live and (known := self.read(key, *copied(sample)[1:])):
                self._take(key, self._not_again(key, known))
        if None in replies or not answered:
            return not self._presence.gateways
        gone = self.values.keys() - answered - self._live
        for key in gone:
            if self.values[key]["quality"] != "bad":
                self._store(key, bad("no-gateway"))
        alive = self._presence.alive
        return alive <= self._presence.trusted and all(
            key in answered for key in self.tags if key.partition("/")[0] in alive
        )

    def _not_again(self, key: str, known: Known) -> Known:
        """An event (a bar code) is passed on when it happens, and never from a query."""
        before = self.values[key]
        if known["quality"] == "bad" or not self.tags[key].get("event"):
            return known
        is_waiting = before["quality"] != "bad" or before["reason"] == "starting"
        return before if is_waiting else bad("starting")

    def distrust(self) -> None:
        """After a pause of this process: no value is good until it was queried again."""
        self._presence.trusted.clear()
        for key in list(self.values):
            self._store(key, bad("no-gateway"))
        self._query_due.set()

    async def write(
        self, key: str, value: object, time: str | None = None, writer: str | None = None
    ) -> Known:
        """Writes once, as `Requests.write`."""
        if key in self.tags:
            return await self.requests.write(key, value, time, writer)
        return {"outcome": "no-gateway", "reason": "no gateway has described this tag"}

    async def past(
        self, key: str, bounds: str, size: int = PAGE
    ) -> AsyncIterator[tuple[list[Known], str | None]]:
        """Yields the samples of a tag in a range of `_time`, page by page, each with a sentence
        where damage has taken some.

        Only the end of a page tells whether all of it has arrived. Raises `GatewayError` where it
        has not.
        """
        after, is_complete = "", False
        while not is_complete:
            replies = await self.requests.ask(
                f"{key}?_time={bounds};page={size}{after}", accept_replies=zenoh.ReplyKeyExpr.ANY
            )
            *found, last = [reply.ok for reply in replies] or [None]
            if last is None or not str(last.key_expr).endswith("/page"):
                raise GatewayError("no gateway has answered")
            try:
                page = orjson.loads(last.payload.to_bytes())
                whole, is_complete, place = page["samples"], page["complete"], f"{page['next']}"
                lost = page.get("damaged")
            except (ValueError, TypeError, LookupError, AttributeError):
                raise GatewayError("the answer is none of a gateway") from None
            read = [self.read(key, *copied(sample)[1:]) for sample in found if sample]
            if whole != len(read):
                raise GatewayError("not all samples have arrived")
            yield [known for known in read if known], lost
            before, after = after, f";after={place}"
            if after == before and not is_complete:
                raise GatewayError("the history does not go on")
