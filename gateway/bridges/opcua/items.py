"""Subscriptions and their monitored items: which changes a client is told.

asyncua loses a value that turns bad if the client asked for a deadband, copies each value for each
client, searches all items for the one that is deleted, and sends all changes in one message.
"""

import asyncio
import dataclasses
from itertools import zip_longest
from typing import Any

from asyncua import ua
from asyncua.server.internal_subscription import InternalSubscription
from asyncua.server.monitored_item_service import (
    MonitoredItemData,
    MonitoredItemService,
    WhereClauseEvaluator,
)

from gateway.bridges.opcua.events import SUPERTYPES, Event

Code = ua.StatusCodes
MOST_TOLD = 1_000  # changes in one message
_OVERFLOW = 0x0480  # the value follows lost ones
_ANY = ua.DataChangeTrigger.StatusValue


class Where(WhereClauseEvaluator):
    """The filter of a client on events."""

    def _eval_el(self, index: int, event: Event) -> Any:
        element = self.elements[index]
        if element.FilterOperator == ua.FilterOperator.OfType:
            return self._eval_op(element.FilterOperands[0], event) in SUPERTYPES[event.EventType]
        return super()._eval_el(index, event)

    def _eval_op(self, op: Any, event: Event) -> Any:
        if isinstance(op, ua.SimpleAttributeOperand):
            return event.field(op).Value
        return super()._eval_op(op, event)


class Items(MonitoredItemService):
    """The monitored items of one subscription."""

    async def _create_data_change_monitored_item(
        self, params: ua.MonitoredItemCreateRequest
    ) -> ua.MonitoredItemCreateResult:
        wanted, given = params.ItemToMonitor, params.RequestedParameters.Filter
        refusal = Code.BadIndexRangeInvalid if wanted.IndexRange else self._bad_filter(given)
        if refusal is None:
            code = self.aspace.read_attribute_value(wanted.NodeId, wanted.AttributeId).StatusCode
            if code is not None and code.value in (
                Code.BadNodeIdUnknown,
                Code.BadAttributeIdInvalid,
            ):
                refusal = code.value
        if refusal is not None:
            return ua.MonitoredItemCreateResult(StatusCode=ua.StatusCode(refusal))
        return await super()._create_data_change_monitored_item(params)

    def _bad_filter(self, given: Any) -> int | None:
        if given is None:
            return None
        if not isinstance(given, ua.DataChangeFilter):
            return Code.BadMonitoredItemFilterUnsupported
        if given.DeadbandType not in (ua.DeadbandType.None_, ua.DeadbandType.Absolute):
            return Code.BadMonitoredItemFilterUnsupported
        return None if given.DeadbandValue >= 0 else Code.BadDeadbandFilterInvalid

    def _create_events_monitored_item(
        self, params: ua.MonitoredItemCreateRequest
    ) -> ua.MonitoredItemCreateResult:
        given = params.RequestedParameters.Filter
        if not isinstance(given, ua.EventFilter):
            code = ua.StatusCode(Code.BadEventFilterInvalid)
            return ua.MonitoredItemCreateResult(StatusCode=code)
        given.SelectClauses = given.SelectClauses or []
        given.WhereClause = given.WhereClause or ua.ContentFilter()
        given.WhereClause.Elements = given.WhereClause.Elements or []
        result = super()._create_events_monitored_item(params)
        if (data := self._monitored_items.get(result.MonitoredItemId)) is not None:
            data.where_clause_evaluator = Where(self.logger, self.aspace, given.WhereClause)
        return result

    def _modify_monitored_item(
        self, params: ua.MonitoredItemModifyRequest
    ) -> ua.MonitoredItemModifyResult:
        data, asked = self._monitored_items.get(params.MonitoredItemId), params.RequestedParameters
        if data is None:
            code = ua.StatusCode(Code.BadMonitoredItemIdInvalid)
            return ua.MonitoredItemModifyResult(StatusCode=code)
        if not isinstance(data.filter, ua.EventFilter):
            if (refusal := self._bad_filter(asked.Filter)) is not None:
                return ua.MonitoredItemModifyResult(StatusCode=ua.StatusCode(refusal))
            data.filter = asked.Filter
        data.queue_size = asked.QueueSize
        return ua.MonitoredItemModifyResult(
            RevisedSamplingInterval=self.isub.data.RevisedPublishingInterval,
            RevisedQueueSize=ua.UInt32(data.queue_size),
        )

    def _delete_monitored_items(self, mid: int) -> ua.StatusCode:
        data = self._monitored_items.pop(mid, None)
        if data is None:
            return ua.StatusCode(Code.BadMonitoredItemIdInvalid)
        if data.callback_handle is not None:
            self._monitored_datachange.pop(data.callback_handle, None)
            self.aspace.delete_datachange_callback(data.callback_handle)
        for node, watching in list(self._monitored_events.items()):
            if mid in watching:
                watching.remove(mid)
            if not watching:
                del self._monitored_events[node]
        self.isub._triggered_datachanges.pop(mid, None)
        self.isub._triggered_events.pop(mid, None)
        return ua.StatusCode()

    async def datachange_callback(
        self, handle: int, value: ua.DataValue, error: ua.StatusCode | None = None
    ) -> None:
        mid = self._monitored_datachange[handle]
        data = self._monitored_items[mid]
        if data.mode == ua.MonitoringMode.Disabled or not _is_change(data, value):
            return
        data.mvalue.current_dvalue = value  # the last one that the client was told
        waiting = self.isub._triggered_datachanges.get(mid, ())
        is_full = 1 < data.queue_size <= len(waiting)
        told = ua.MonitoredItemNotification(ua.UInt32(data.client_handle or 0), value)
        await self.isub.enqueue_datachange_event(mid, told, data.queue_size)
        if is_full:
            oldest = self.isub._triggered_datachanges[mid][0]
            code = oldest.Value.StatusCode.value if oldest.Value.StatusCode else 0
            marked = ua.StatusCode(ua.UInt32(code | _OVERFLOW))
            oldest.Value = dataclasses.replace(oldest.Value, StatusCode=marked)


class Subscription(InternalSubscription):
    """A subscription, whose messages have an end."""

    def __init__(self, data: Any, aspace: Any, *given: Any, **others: Any) -> None:
        super().__init__(data, aspace, *given, **others)
        self.monitored_item_srv = Items(self, aspace)

    async def publish_results(self, requestdata: Any = None) -> bool:
        """Returns True if it used the request."""
        used = more = await super().publish_results(requestdata)
        while more and self._publishing_enabled and self._triggered_datachanges:
            await asyncio.sleep(0)
            more = await super().publish_results()
        return bool(used)

    def _pop_publish_result(self) -> ua.PublishResult:
        result = super()._pop_publish_result()
        result.MoreNotifications = bool(self._triggered_datachanges)
        return result

    def _pop_triggered_datachanges(self, result: ua.PublishResult) -> None:
        waiting, taken = self._triggered_datachanges, list[ua.MonitoredItemNotification]()
        while waiting and len(taken) < MOST_TOLD:
            taken += waiting.pop(next(iter(waiting)))
        if taken:
            told = ua.DataChangeNotification(MonitoredItems=taken)
            result.NotificationMessage.NotificationData.append(told)


def _is_change(data: MonitoredItemData, new: ua.DataValue) -> bool:
    old, given = data.mvalue.current_dvalue, data.filter
    if old is None or old.StatusCode != new.StatusCode:
        return True
    trigger = _ANY if given is None else given.Trigger
    if trigger == ua.DataChangeTrigger.Status:
        return False
    if trigger != _ANY and old.SourceTimestamp != new.SourceTimestamp:
        return True
    if old.Value == new.Value:
        return False
    if given is None or given.DeadbandType == ua.DeadbandType.None_:
        return True
    return _is_beyond(old.Value, new.Value, given.DeadbandValue)


def _is_beyond(old: ua.Variant | None, new: ua.Variant | None, deadband: float) -> bool:
    """A deadband is for numbers; every other value is told."""
    pair = [one.Value if one is not None else None for one in (old, new)]
    before, now = (one if isinstance(one, list) else [one] for one in pair)
    for one, other in zip_longest(before, now):
        if not isinstance(one, int | float) or not isinstance(other, int | float):
            return True
        if abs(other - one) > deadband:
            return True
    return False
