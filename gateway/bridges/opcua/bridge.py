"""The gateways as an OPC UA server: values, writes, and what changes while it runs."""

import asyncio
import math
from collections import deque
from collections.abc import Coroutine, Sequence
from typing import Any

import zenoh
from asyncua import ua
from asyncua.crypto.permission_rules import User

from gateway.bridges.documents import Known, bad, utc_now
from gateway.bridges.opcua.admission import Admission
from gateway.bridges.opcua.alarms import Alarms
from gateway.bridges.opcua.sessions import Core, Session
from gateway.bridges.opcua.space import MOST_TAGS, Tree
from gateway.bridges.opcua.values import data_value, type_of
from gateway.bridges.program import say
from gateway.bridges.remote_plant import RemotePlant

Code = ua.StatusCodes
NOT_DONE = {  # by the outcome of a write
    "not-writable": Code.BadNotWritable,
    "bad-value": Code.BadOutOfRange,
    "unknown-tag": Code.BadNodeIdUnknown,
    "not-allowed": Code.BadUserAccessDenied,
    "wrong-device": Code.BadConfigurationError,
    "busy": Code.BadTooManyOperations,
    "line-down": Code.BadNotConnected,
    "no-reply": Code.BadDeviceFailure,
    "refused": Code.BadInvalidState,
    "no-gateway": Code.BadNoCommunication,
}
MOST_WRITES, MOST_WRITES_OF_USER = 200, 100  # that wait; the next one is refused
MOST_CHANGES = 100_000  # that wait; beyond, only the last one of each tag
AT_ONCE = 200  # changes between two turns of the connections


class Bridge:
    """The plant as the sessions of clients see it."""

    def __init__(
        self, session: zenoh.Session, prefix: str, space: int, core: Core, admission: Admission
    ) -> None:
        self.tree = Tree(space, prefix, self._value)
        self.plant = RemotePlant(session, prefix, self._described, self._changed, self.tree.arrange)
        self.alarms = Alarms(
            session, prefix, self.plant.requests, self.tree, core.subscription_service
        )
        self._admission = admission
        self._changes: deque[tuple[str, Known]] = deque()
        self._news = asyncio.Event()
        self._writing: list[str | None] = []  # the user of each write that waits
        self._is_full = False
        self.lost = 0  # changes that no client was told

    def _described(self, key: str, meta: Known) -> None:
        if key in self.plant.values:  # of the type before
            self.plant.values[key] = bad("starting")
            self._changed(key, self.plant.values[key])
        if not self.tree.describe(key, meta) and not self._is_full:
            self._is_full = True
            say(f"{MOST_TAGS} tags are all that this server takes: the others are left out")

    def _value(self, key: str) -> ua.DataValue:
        is_held = self._admission.is_held()
        known = bad("no-gateway") if is_held else self.plant.values.get(key) or bad("starting")
        return data_value(known, type_of(self.tree.tags[key]))

    def _changed(self, key: str, known: Known) -> None:
        if not self.tree.watched.get(key):
            return
        self._changes.append((key, known))
        self._news.set()
        if len(self._changes) > MOST_CHANGES:
            last = dict(self._changes)
            self.lost += len(self._changes) - len(last)
            self._changes = deque(last.items())

    async def serve(self) -> None:
        """Passes the changes on to the clients that watch."""
        while True:
            await self._news.wait()
            self._news.clear()
            while self._changes:
                for _ in range(min(AT_ONCE, len(self._changes))):
                    await self._tell(*self._changes.popleft())
                await asyncio.sleep(0)

    async def _tell(self, key: str, known: Known) -> None:
        watching = self.tree.watched.get(key)
        if watching and key in self.tree.tags:
            value = data_value(known, type_of(self.tree.tags[key]))
            for handle, tell in list(watching.items()):
                if handle in watching:
                    await tell(handle, value)

    def distrust(self) -> None:
        """After a pause of this process: what is known may be long over."""
        self.plant.distrust()

    async def write(self, item: ua.WriteValue, user: User) -> int:
        """Writes once. Returns a status code: Good only if the device has acknowledged."""
        key = item.NodeId.Identifier
        if (code := self._refusal(item, user)) is not None:
            return code
        own = self._writing.count(user.name)
        if len(self._writing) >= MOST_WRITES or own >= MOST_WRITES_OF_USER:
            return Code.BadTooManyOperations
        value = item.Value.Value.Value
        self._writing.append(user.name)
        try:
            writer = self._admission.secret_of(user)
            outcome = await self.plant.write(key, value, utc_now(), writer)
        finally:
            self._writing.remove(user.name)
        found = outcome["outcome"]
        say(f"{user.name} writes {key} = {str(value)[:60]}: {found} {outcome.get('reason', '')}")
        return Code.Good if found == "written" else NOT_DONE.get(found, Code.BadTimeout)

    def _refusal(self, item: ua.WriteValue, user: User) -> int | None:
        """Returns the code of a write that is not sent."""
        key, variant, code = item.NodeId.Identifier, item.Value.Value, item.Value.StatusCode
        meta = self.tree.tags.get(key) if item.NodeId.NamespaceIndex == self.tree.space else None
        if meta is None:
            return Code.BadNotWritable
        if not self._admission.may_write(user):
            return Code.BadUserAccessDenied
        if item.AttributeId != ua.AttributeIds.Value or item.IndexRange:
            return Code.BadWriteNotSupported
        if not meta["write"]:
            return Code.BadNotWritable
        if code is not None and code.value != Code.Good:
            return Code.BadWriteNotSupported
        if variant is None or variant.VariantType != type_of(meta):
            return Code.BadTypeMismatch
        if variant.is_array != bool(meta.get("length")):
            return Code.BadTypeMismatch
        values = variant.Value if variant.is_array else [variant.Value]
        if not all(_is_finite(one) for one in values or ()):
            return Code.BadOutOfRange
        return None if values else Code.BadTypeMismatch

    async def call(self, method: ua.CallMethodRequest, session: Session) -> ua.CallMethodResult:
        return await self.alarms.call(method, session)

    def parts(self) -> Sequence[Coroutine[Any, Any, None]]:
        """Returns what runs beside the server."""
        return self.serve(), self.plant.follow(), self.alarms.follow(), self.alarms.serve()


def _is_finite(value: object) -> bool:
    if isinstance(value, float):
        return math.isfinite(value)
    return isinstance(value, int | str)
