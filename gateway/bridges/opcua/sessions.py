"""The sessions of OPC UA clients: what each may do, and how much."""

import asyncio
import dataclasses
import math
import secrets
from collections.abc import Awaitable, Callable, Sequence
from typing import Any, Protocol, cast

from asyncua import ua
from asyncua.common.utils import ServiceError
from asyncua.crypto.permission_rules import User, UserRole
from asyncua.server.internal_server import InternalServer
from asyncua.server.internal_session import InternalSession, SessionState
from asyncua.server.internal_subscription import InternalSubscription

from gateway.bridges.opcua.admission import (
    EVENT_QUEUE,
    MOST_ITEMS,
    MOST_ITEMS_OF_SESSION,
    MOST_OF_SESSION,
    MOST_OF_USER,
    MOST_OPERATIONS,
    MOST_SESSIONS,
    MOST_SUBSCRIPTIONS,
    QUEUE,
    Admission,
    limited,
    revise,
)
from gateway.bridges.opcua.browsing import Views

Code = ua.StatusCodes
FASTEST, SLOWEST = 50.0, 60_000.0  # ms between two messages of a subscription
_WRITE = ua.AccessLevel.CurrentWrite.mask


class Plant(Protocol):
    """The plant, as far as the sessions use it."""

    async def write(self, item: ua.WriteValue, user: User) -> int: ...

    async def call(
        self, method: ua.CallMethodRequest, session: "Session"
    ) -> ua.CallMethodResult: ...


class Core(InternalServer):
    """The server without its connections."""

    plant: Plant

    def __init__(self, admission: Admission) -> None:
        self.admission = admission
        super().__init__(user_manager=cast("Any", admission))
        self.view_service = Views(self.aspace)
        self.allow_remote_admin = False
        self.match_discovery_source_ip = False
        self.min_session_timeout_ms = 10_000.0
        self.max_pending_activation_seconds = 15.0
        self.max_subscriptions = MOST_SUBSCRIPTIONS
        self.max_unacked_messages_per_subscription = 20
        self.max_monitored_item_queue_size = EVENT_QUEUE

    def create_session(
        self,
        name: str,
        user: User = User(role=UserRole.Anonymous),  # noqa: B008  (asyncua's signature)
        external: bool = False,
    ) -> InternalSession:
        return Session(self, name, user, external)

    def sessions(self) -> list["Session"]:
        return cast("list[Session]", list(self._external_sessions.values()))

    def is_full(self) -> bool:
        return len(self._external_sessions) >= MOST_SESSIONS


class Session(InternalSession):
    """A session. Its token cannot be guessed, and its user does not change."""

    iserver: Core
    user: User

    def __init__(self, core: Core, name: str, user: User, external: bool) -> None:
        super().__init__(core, core.aspace, core.subscription_service, name, user, external)
        self.certificate: bytes | None = None  # of the client's application
        self._processor: Any = None
        self._transport: asyncio.Transport | None = None
        core.unregister_external_session(self)
        self.auth_token = ua.NodeId(secrets.token_bytes(32), 0)
        core.register_external_session(self)
        self._rest: dict[bytes, list[ua.ReferenceDescription]] = {}  # by continuation point

    def is_closed(self) -> bool:
        return self.state is SessionState.Closed

    def is_of(self, processor: object) -> bool:
        return self._processor is processor

    def taken_by(self, processor: object, transport: asyncio.Transport) -> None:
        """The session goes on with this connection, and with no other."""
        if self._transport is not None and self._transport is not transport:
            self._transport.abort()
        self._processor, self._transport = processor, transport

    async def end(self) -> None:
        """Ends it with its connection."""
        await self.close_session(True)
        if self._transport is not None:
            self._transport.abort()

    def activate_session(
        self, params: ua.ActivateSessionParameters, peer_certificate: bytes | None
    ) -> ua.ActivateSessionResult:
        before, was_active = self.user, self.is_activated()
        result = super().activate_session(params, peer_certificate)
        if was_active and self.user != before:
            self.user = before
            raise ServiceError(Code.BadIdentityChangeNotSupported)
        users = [one.user for one in self.iserver.sessions() if one.is_activated()]
        if users.count(self.user) > MOST_OF_USER:
            self._closing = asyncio.ensure_future(self.close_session(True))
            raise ServiceError(Code.BadTooManySessions)
        return result

    # -- values --

    async def read(self, params: ua.ReadParameters) -> list[ua.DataValue]:
        found = await super().read(limited(params, "NodesToRead"))
        for place, item in enumerate(params.NodesToRead):
            if item.IndexRange:
                found[place] = ua.DataValue(StatusCode=ua.StatusCode(Code.BadIndexRangeInvalid))
            elif item.AttributeId == ua.AttributeIds.UserAccessLevel:
                found[place] = self._access(found[place])
        return found

    def _access(self, found: ua.DataValue) -> ua.DataValue:
        if found.Value is None or self.iserver.admission.may_write(self.user):
            return found
        allowed = ua.Variant(found.Value.Value & ~_WRITE, found.Value.VariantType)
        return dataclasses.replace(found, Value=allowed)

    async def write(self, params: ua.WriteParameters) -> list[ua.StatusCode]:
        items = limited(params, "NodesToWrite").NodesToWrite
        codes = await asyncio.gather(*(self.iserver.plant.write(one, self.user) for one in items))
        return [ua.StatusCode(code) for code in codes]

    async def history_read(self, params: ua.HistoryReadParameters) -> list[ua.HistoryReadResult]:
        return await super().history_read(limited(params, "NodesToRead", 100))

    async def call(self, params: list[ua.CallMethodRequest]) -> list[ua.CallMethodResult]:
        if len(params) > 100:
            raise ServiceError(Code.BadTooManyOperations)
        return [await self.iserver.plant.call(method, self) for method in params]

    # -- nodes --

    async def browse(self, params: ua.BrowseParameters) -> list[ua.BrowseResult]:
        nodes = limited(params, "NodesToBrowse").NodesToBrowse
        most = params.RequestedMaxReferencesPerNode
        return await self.iserver.view_service.browse_all(nodes, most, self._rest)

    async def browse_next(self, parameters: ua.BrowseNextParameters) -> list[ua.BrowseResult]:
        points = limited(parameters, "ContinuationPoints").ContinuationPoints
        view, release = self.iserver.view_service, parameters.ReleaseContinuationPoints
        return [view.go_on(point, release, self._rest) for point in points]

    async def translate_browsepaths_to_nodeids(
        self, params: list[ua.BrowsePath]
    ) -> list[ua.BrowsePathResult]:
        if len(params) > MOST_OPERATIONS:
            raise ServiceError(Code.BadTooManyOperations)
        found = []
        for path in params:
            found += self.iserver.view_service.translate_browsepaths_to_nodeids([path])
            await asyncio.sleep(0)
        return found

    # -- subscriptions --

    def own(self, subscription: int) -> InternalSubscription:
        """Returns a subscription of this session. asyncua lets a client use those of others."""
        found = self.subscription_service.subscriptions.get(subscription)
        if found is None or found.session_id != self.session_id:
            raise ServiceError(Code.BadSubscriptionIdInvalid)
        return found

    def owned(self) -> list[InternalSubscription]:
        every = self.subscription_service.subscriptions.values()
        return [one for one in every if one.session_id == self.session_id]

    async def create_subscription(
        self,
        params: ua.CreateSubscriptionParameters,
        callback: Callable[..., Awaitable[None]],
        request_callback: Callable[..., Any] | None = None,
    ) -> ua.CreateSubscriptionResult:
        if len(self.owned()) >= MOST_OF_SESSION:
            raise ServiceError(Code.BadTooManySubscriptions)
        asked = params.RequestedPublishingInterval
        asked = asked if math.isfinite(asked) else SLOWEST
        params.RequestedPublishingInterval = min(max(asked, FASTEST), SLOWEST)
        return await super().create_subscription(params, callback, request_callback)

    def modify_subscription(
        self, params: ua.ModifySubscriptionParameters
    ) -> ua.ModifySubscriptionResult:
        self.own(params.SubscriptionId)
        return super().modify_subscription(params)

    async def delete_subscriptions(self, ids: Sequence[int]) -> list[ua.StatusCode]:
        own = [one.data.SubscriptionId for one in self.owned()]
        wanted = [one if one in own else 0 for one in ids]  # 0 is no subscription
        return list(await super().delete_subscriptions(wanted))

    async def transfer_subscriptions(
        self, params: ua.TransferSubscriptionsParameters, callback: Callable[..., Awaitable[None]]
    ) -> list[ua.TransferResult]:
        """Only between sessions of one user and application."""
        found = {one.session_id: one for one in self.iserver.sessions()}
        results = []
        for number in params.SubscriptionIds:
            subscription = self.subscription_service.subscriptions.get(int(number))
            before = found.get(subscription.session_id) if subscription else None
            if before is None or (before.user, before.certificate) != (self.user, self.certificate):
                code = ua.StatusCode(Code.BadSubscriptionIdInvalid)
                results.append(ua.TransferResult(StatusCode=code))
                continue
            one = dataclasses.replace(params, SubscriptionIds=[number])
            results += await super().transfer_subscriptions(one, callback)
            if subscription is not None and self._processor is not None:
                subscription.pub_request_callback = self._processor.get_publish_request
        return results

    def publish(
        self, acks: Sequence[ua.SubscriptionAcknowledgement] | None = None
    ) -> tuple[int, list[ua.StatusCode]]:
        own = {one.data.SubscriptionId: one for one in self.owned()}
        if not own:
            raise ServiceError(Code.BadNoSubscription)
        codes = []
        for ack in acks or ():
            if (subscription := own.get(ack.SubscriptionId)) is None:
                codes.append(ua.StatusCode(Code.BadSubscriptionIdInvalid))
            else:
                subscription.publish([ack.SequenceNumber])
                codes.append(ua.StatusCode())
        return len(own), codes

    def republish(self, params: ua.RepublishParameters) -> ua.NotificationMessage:
        found = self.own(params.SubscriptionId).republish(params.RetransmitSequenceNumber)
        if not found.SequenceNumber:
            raise ServiceError(Code.BadMessageNotAvailable)
        return found

    async def set_publishing_mode(
        self, params: ua.SetPublishingModeParameters
    ) -> list[ua.StatusCode]:
        for number in params.SubscriptionIds:
            self.own(number)
        return await super().set_publishing_mode(params)

    # -- monitored items --

    async def create_monitored_items(
        self, params: ua.CreateMonitoredItemsParameters
    ) -> list[ua.MonitoredItemCreateResult]:
        self.own(params.SubscriptionId)
        wanted = limited(params, "ItemsToCreate").ItemsToCreate
        every = self.subscription_service.subscriptions.values()
        in_all = sum(len(one.monitored_item_srv._monitored_items) for one in every)
        own = sum(len(one.monitored_item_srv._monitored_items) for one in self.owned())
        if in_all + len(wanted) > MOST_ITEMS or own + len(wanted) > MOST_ITEMS_OF_SESSION:
            raise ServiceError(Code.BadTooManyMonitoredItems)
        for item in wanted:
            is_event = item.ItemToMonitor.AttributeId == ua.AttributeIds.EventNotifier
            revise(item.RequestedParameters, EVENT_QUEUE if is_event else QUEUE, is_event)
        return await super().create_monitored_items(params)

    async def modify_monitored_items(
        self, params: ua.ModifyMonitoredItemsParameters
    ) -> list[ua.MonitoredItemModifyResult]:
        self.own(params.SubscriptionId)
        for item in limited(params, "ItemsToModify").ItemsToModify:
            revise(item.RequestedParameters, QUEUE, False)
        return await super().modify_monitored_items(params)

    async def delete_monitored_items(
        self, params: ua.DeleteMonitoredItemsParameters
    ) -> list[ua.StatusCode]:
        self.own(params.SubscriptionId)
        return await super().delete_monitored_items(limited(params, "MonitoredItemIds"))

    async def set_monitoring_mode(
        self, params: ua.SetMonitoringModeParameters
    ) -> list[ua.StatusCode]:
        self.own(params.SubscriptionId)
        return await super().set_monitoring_mode(limited(params, "MonitoredItemIds"))
