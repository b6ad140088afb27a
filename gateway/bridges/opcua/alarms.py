"""The alarms of the gateways as conditions: their events, and the orders of clients about them."""

import asyncio
from collections import deque
from contextlib import suppress
from typing import Any, NamedTuple

import orjson
import zenoh
from asyncua import ua
from asyncua.common.utils import ServiceError
from asyncua.server.subscription_service import SubscriptionService

from gateway.bridges.documents import Known, utc_now
from gateway.bridges.opcua.events import Event, of_alarm, raised_of, refresh
from gateway.bridges.opcua.sessions import Session
from gateway.bridges.opcua.space import Tree
from gateway.bridges.requests import Inbox, Requests

Code, Ids = ua.StatusCodes, ua.ObjectIds
MOST_ALARMS = 20_000
QUERY_EVERY = 60.0  # seconds between two queries of all alarms without a known reason
_ACKNOWLEDGE = ua.NodeId(Ids.AcknowledgeableConditionType_Acknowledge)
_REFRESH = {
    ua.NodeId(Ids.ConditionType_ConditionRefresh),
    ua.NodeId(Ids.ConditionType_ConditionRefresh2),
}
_NOT_DONE = {  # by the outcome of an order
    "nothing-to-acknowledge": Code.BadConditionBranchAlreadyAcked,
    "unknown-tag": Code.BadNodeIdUnknown,
    "not-allowed": Code.BadUserAccessDenied,
    "bad-value": Code.BadInvalidArgument,
    "busy": Code.BadTooManyOperations,
    "no-gateway": Code.BadNoCommunication,
}
_TOLD = "state", "level", "since", "raised", "acknowledged", "shelved", "out_of_service", "priority"


class _Condition(NamedTuple):
    document: Known
    gateway: str
    quality: int  # a status code: bad while its gateway is not there


class Alarms:
    """All alarms under a prefix."""

    def __init__(
        self,
        session: zenoh.Session,
        prefix: str,
        requests: Requests,
        tree: Tree,
        subscriptions: SubscriptionService,
    ) -> None:
        self._requests, self._tree, self._subscriptions = requests, tree, subscriptions
        self._conditions: dict[str, _Condition] = {}
        self._due, self._news = asyncio.Event(), asyncio.Event()
        self._events: deque[Event] = deque(maxlen=MOST_ALARMS)
        self._own = f"{prefix}/@gateway/"
        inbox = Inbox(self._due.set)
        self._declared = [
            session.declare_subscriber(f"{self._own}*/alarms/**", inbox.callback(self._sample)),
            session.liveliness().declare_subscriber(
                f"{self._own}*", inbox.callback(self._token, always=True), history=True
            ),
        ]

    async def follow(self) -> None:
        """Queries all alarms after every change of gateways, and regularly."""
        while True:
            self._due.clear()
            for reply in await self._requests.ask("@gateway/*/alarms/**"):
                if (sample := reply.ok) is not None:
                    self._sample(str(sample.key_expr), True, sample.payload.to_bytes(), b"")
            with suppress(TimeoutError):
                async with asyncio.timeout(QUERY_EVERY):
                    await self._due.wait()

    async def serve(self) -> None:
        """Passes the events on to the clients."""
        while True:
            await self._news.wait()
            self._news.clear()
            while self._events:
                event = self._events.popleft()
                for one in list(self._subscriptions.subscriptions.values()):
                    await one.monitored_item_srv.trigger_event(event)

    def _sample(self, key: str, is_put: bool, payload: bytes, _about: bytes) -> None:
        gateway, _, alarm = key.removeprefix(self._own).partition("/alarms/")
        with suppress(ValueError, KeyError, TypeError):  # from another program
            document = orjson.loads(payload if is_put else b"")
            if document["alarm"] == alarm:
                self._take(_Condition(document, gateway, Code.Good))

    def _take(self, new: _Condition) -> None:
        alarm = new.document["alarm"]
        before = self._conditions.get(alarm)
        if before is None and len(self._conditions) >= MOST_ALARMS:
            return
        event = self._event(new)  # raises an error for a document that is none
        self._conditions[alarm] = new
        is_news = (
            new.document["state"] != "normal" if before is None else _told(before) != _told(new)
        )
        if is_news:
            self._tell(event)

    def _token(self, key: str, there: bool, _payload: bytes, _about: bytes) -> None:
        gateway = key.removeprefix(self._own)
        if there:
            self._due.set()
            return
        for alarm, known in self._conditions.items():
            if known.gateway == gateway:
                lost = known._replace(quality=Code.BadNoCommunication)
                self._conditions[alarm] = lost
                if known.document["state"] != "normal":
                    self._tell(self._event(lost))

    def _event(self, known: _Condition) -> Event:
        condition = self._tree.add_alarm(known.document["alarm"])
        source = self._tree.source_of(known.document["alarm"])
        return of_alarm(known.document, condition, source, known.quality)

    def _tell(self, event: Event) -> None:
        self._events.append(event)
        self._news.set()

    # -- methods --

    async def call(self, method: ua.CallMethodRequest, session: Session) -> ua.CallMethodResult:
        arguments = [one.Value for one in method.InputArguments or ()]
        try:
            if method.MethodId in _REFRESH:
                code = await self._refresh(arguments, session)
            elif method.MethodId == _ACKNOWLEDGE:
                code = await self._acknowledge(method.ObjectId.Identifier, arguments, session)
            else:
                code = Code.BadMethodInvalid
        except ServiceError as error:
            code = error.code
        return ua.CallMethodResult(StatusCode=ua.StatusCode(code))

    async def _refresh(self, arguments: list[Any], session: Session) -> int:
        """Repeats the events of all alarms that are not normal, for one subscription."""
        if not arguments or not all(isinstance(one, int) for one in arguments):
            return Code.BadInvalidArgument
        items = session.own(arguments[0]).monitored_item_srv
        only = arguments[1] if len(arguments) > 1 else None
        await items.trigger_event(refresh(True), only)
        for known in list(self._conditions.values()):
            if known.document["state"] != "normal":
                await items.trigger_event(self._event(known), only)
        await items.trigger_event(refresh(False), only)
        return Code.Good

    async def _acknowledge(self, node: object, arguments: list[Any], session: Session) -> int:
        alarm = str(node).removesuffix("@alarm")
        known = self._conditions.get(alarm)
        if known is None:
            return Code.BadNodeIdUnknown
        admission = session.iserver.admission
        if not admission.may_write(session.user):
            return Code.BadUserAccessDenied
        if not arguments or not isinstance(arguments[0], bytes):
            return Code.BadEventIdUnknown
        raised = raised_of(arguments[0], alarm)
        if not raised:
            return Code.BadEventIdUnknown
        outcome = await self._requests.order(
            f"@gateway/{known.gateway}/alarms/{alarm}",
            orjson.dumps({"by": session.user.name, "raised": raised}),
            utc_now(),
            admission.secret_of(session.user),
        )
        if "outcome" not in outcome:
            self._take(known._replace(document=outcome))
            return Code.Good
        return _NOT_DONE.get(outcome["outcome"], Code.BadTimeout)


def _told(known: _Condition) -> list[object]:
    return [known.quality, *map(known.document.get, _TOLD)]
