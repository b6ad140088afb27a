"""HistoryRead: raw values and aggregates from the history of the gateways."""

from datetime import UTC, datetime, timedelta

from asyncua import ua
from asyncua.common.utils import ServiceError
from asyncua.server.history import HistoryManager
from asyncua.server.internal_server import InternalServer

from gateway.bridges.documents import Known, copied
from gateway.bridges.opcua.aggregates import Aggregates
from gateway.bridges.opcua.values import data_value, type_of
from gateway.bridges.remote_plant import RemotePlant
from gateway.errors import GatewayError

STEP = timedelta(microseconds=1)
MOST_SAMPLES = 10_000  # in one answer; the client gets the rest with the continuation point


def _text(time: datetime | None) -> str:
    return "" if time is None else f"{time:%Y-%m-%dT%H:%M:%S.%fZ}"


class History(HistoryManager):
    """Answers HistoryRead from the history of the gateway."""

    def __init__(self, iserver: InternalServer, plant: RemotePlant) -> None:
        super().__init__(iserver)
        self._plant, self._aggregates = plant, Aggregates(plant)

    async def read_history(self, params: ua.HistoryReadParameters) -> list[ua.HistoryReadResult]:
        results, details = [], params.HistoryReadDetails
        wanted: list[ua.NodeId | None] = [None] * len(params.NodesToRead)
        if isinstance(details, ua.ReadProcessedDetails):
            if len(details.AggregateType or ()) != len(wanted):
                raise ServiceError(ua.StatusCodes.BadAggregateListMismatch)
            wanted = list(details.AggregateType)
        for item, aggregate in zip(params.NodesToRead, wanted, strict=True):
            result = ua.HistoryReadResult(HistoryData=ua.HistoryData())
            try:
                if not self._plant.tags.get(item.NodeId.Identifier, {}).get("history"):
                    raise ua.uaerrors.BadHistoryOperationUnsupported
                if aggregate is None:
                    found = await self._history(details, item)
                else:
                    found = await self._aggregates.read(details, aggregate, item)
                result.HistoryData.DataValues, result.ContinuationPoint = found
            except ua.UaStatusCodeError as error:
                result.StatusCode = ua.StatusCode(error.code)
            except GatewayError:
                result.StatusCode = ua.StatusCode(ua.StatusCodes.BadNoCommunication)
            except (ValueError, LookupError, TypeError):  # of another program
                result.StatusCode = ua.StatusCode(ua.StatusCodes.BadCommunicationError)
            results.append(result)
        return results

    async def _history(
        self, details: object, item: ua.HistoryReadValueId
    ) -> tuple[list[ua.DataValue], bytes | None]:
        """Returns samples and a continuation point: the time of the next one."""
        key = item.NodeId.Identifier
        if not isinstance(details, ua.ReadRawModifiedDetails) or details.IsReadModified:
            raise ua.uaerrors.BadHistoryOperationUnsupported
        start, end = (
            None if time is None or time <= ua.get_win_epoch() else time.astimezone(UTC)
            for time in (details.StartTime, details.EndTime)
        )
        backwards = start is None or (end is not None and end < start)
        if start is None:  # the last ones before a time
            start, end = end, None
        if item.ContinuationPoint:
            try:
                start = datetime.fromisoformat(item.ContinuationPoint.decode())
            except ValueError:
                raise ua.uaerrors.BadContinuationPointInvalid from None
        if start is None:
            raise ua.uaerrors.BadInvalidTimestampArgument
        wanted = min(details.NumValuesPerNode or MOST_SAMPLES, MOST_SAMPLES)
        # The bound where it starts is included. The gateway keeps nanoseconds, and shows less.
        if backwards:
            until = f"{_text(start + STEP)}["
            begin = await self._oldest_of_last(key, f"]{_text(end)}..{until}", wanted + 1)
            samples = await self._samples(key, f"{begin or f']{_text(end)}'}..{until}", None)
        else:
            samples = await self._samples(key, f"[{_text(start)}..{_text(end)}[", wanted + 1)
        samples.sort(key=lambda known: known["time"], reverse=backwards)
        rest = samples[wanted]["time"].encode() if len(samples) > wanted else None
        kind = type_of(self._plant.tags[key])
        return [data_value(known, kind) for known in samples[:wanted]], rest

    async def _oldest_of_last(self, key: str, bounds: str, count: int) -> str:
        """Returns the bound at the oldest of the last samples: the first reply, also of a broken
        answer."""
        for reply in await self._plant.requests.ask(f"{key}?_time={bounds};last={count}"):
            if reply.ok and (known := self._plant.read(key, *copied(reply.ok)[1:])):
                return f"[{known['time']}"
        return ""

    async def _samples(self, key: str, bounds: str, wanted: int | None) -> list[Known]:
        """Returns at least the first `wanted` samples, or all of them."""
        samples: list[Known] = []
        async for found, lost in self._plant.past(key, bounds, wanted or MOST_SAMPLES):
            if lost is not None:
                raise ua.uaerrors.BadDataLost
            samples += found
            if wanted is not None and len(samples) >= wanted:
                break
        return samples
