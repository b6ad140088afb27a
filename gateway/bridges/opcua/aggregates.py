"""HistoryRead of aggregates (OPC UA part 13), from the buckets or the samples of the gateway.

A value is valid until the next one (Stepped). So the aggregates with bounding values are those of
the buckets. `Average`, `Minimum`, `Maximum` and `Range` are of samples only, which no bucket has.
"""

from collections import defaultdict
from collections.abc import Callable, Mapping
from datetime import UTC, datetime, timedelta
from statistics import fmean
from typing import NamedTuple

import orjson
from asyncua import ua

from gateway.bridges.documents import Known
from gateway.bridges.opcua.values import ORIGIN, type_of, variant_of
from gateway.bridges.remote_plant import RemotePlant

Code, Type, Ids = ua.StatusCodes, ua.VariantType, ua.ObjectIds
Interval = tuple[int, object]  # a status code, and the value; None: there is none
MOST_INTERVALS = 10_000  # in one answer; the client gets the rest with the continuation point
MOST_SAMPLES = 200_000  # that one answer may need
LATE = timedelta(minutes=1)  # the last bucket ends now, by the clock of the gateway
_CALCULATED, _PARTIAL = 0x0401, 0x0404  # info bits of a status code


class _Aggregate(NamedTuple):
    """`of`: the value from a bucket and the length of the interval (s), or from the good samples.
    `type` None: that of the tag. `always`: there is a value also where no sample is good."""

    of: Callable[..., object]
    type: ua.VariantType | None = Type.Double
    always: bool = False


_OF_BUCKETS = {
    "TimeAverage": _Aggregate(lambda bucket, _: bucket["mean"]),
    "TimeAverage2": _Aggregate(lambda bucket, _: bucket["mean"]),
    "Minimum2": _Aggregate(lambda bucket, _: bucket["min"], None),
    "Maximum2": _Aggregate(lambda bucket, _: bucket["max"], None),
    "Range2": _Aggregate(lambda bucket, _: bucket["max"] - bucket["min"]),
    "Count": _Aggregate(lambda bucket, _: bucket["good"], Type.Int32, always=True),
    "DurationGood": _Aggregate(lambda bucket, _: bucket["known"] * 1e3, always=True),
    "DurationBad": _Aggregate(lambda bucket, length: (length - bucket["known"]) * 1e3, always=True),
    "PercentGood": _Aggregate(lambda bucket, length: 100 * bucket["known"] / length, always=True),
    "PercentBad": _Aggregate(
        lambda bucket, length: 100 - 100 * bucket["known"] / length, always=True
    ),
}
_OF_SAMPLES = {
    "Average": _Aggregate(fmean),
    "Minimum": _Aggregate(min, None),
    "Maximum": _Aggregate(max, None),
    "Range": _Aggregate(lambda values: max(values) - min(values)),
}
_ALL = _OF_BUCKETS | _OF_SAMPLES
NAMES = {ua.NodeId(getattr(Ids, f"AggregateFunction_{name}")): name for name in _ALL}
_EMPTY: Known = {"quality": "bad", "good": 0, "bad": 0, "known": 0.0}


class Aggregates:
    """Reads aggregates of the history of the gateways."""

    def __init__(self, plant: RemotePlant) -> None:
        self._plant = plant

    async def read(
        self, details: ua.ReadProcessedDetails, aggregate: ua.NodeId, item: ua.HistoryReadValueId
    ) -> tuple[list[ua.DataValue], bytes | None]:
        """Returns a value for each interval, and a continuation point. Raises `ua.UaError`."""
        key, meta = item.NodeId.Identifier, self._plant.tags[item.NodeId.Identifier]
        if (name := NAMES.get(aggregate)) is None:
            raise ua.uaerrors.BadAggregateNotSupported
        if meta["type"].startswith("string") or meta.get("length"):
            raise ua.uaerrors.BadAggregateInvalidInputs
        start, end, width = _intervals(details, item.ContinuationPoint)
        stop = end if (end - start) / width <= MOST_INTERVALS else start + MOST_INTERVALS * width
        read = self._of_buckets if name in _OF_BUCKETS else self._of_samples
        kind, now = _ALL[name].type or type_of(meta), datetime.now(UTC)
        found = await read(key, _ALL[name], start, stop, width)
        values = []
        for place in range(-((start - stop) // width)):
            at = start + place * width
            code, value = found(place, min(width, end - at).total_seconds())
            variant = None if value is None else variant_of(_as(value, kind), kind)
            if variant is not None:
                code |= _PARTIAL | _CALCULATED if end - at < width else _CALCULATED
            elif value is not None:
                code = Code.BadTypeMismatch
            values.append(ua.DataValue(variant or ua.Variant(), ua.StatusCode(code), at, now))
        return values, _text(stop).encode() if stop < end else None

    async def _of_buckets(
        self, key: str, one: _Aggregate, start: datetime, stop: datetime, width: timedelta
    ) -> Callable[[int, float], Interval]:
        bounds = f"[{_text(start)}..{_text(stop)}["
        query = f"_time={bounds};bucket={width.total_seconds():.6f};align=start"
        buckets: dict[int, Known] = {}
        for reply in await self._plant.requests.ask(f"{key}?{query}"):
            if reply.ok is None:
                raise ua.uaerrors.BadDataLost
            bucket = orjson.loads(reply.ok.payload.to_bytes())
            buckets[(datetime.fromisoformat(bucket["time"]) - start) // width] = bucket
        if not buckets:  # no sample: or no gateway, which raises an error
            _, lost = await anext(self._plant.past(key, bounds))
            if lost is not None:
                raise ua.uaerrors.BadDataLost
        elif start + (max(buckets) + 1) * width < min(stop, datetime.now(UTC) - LATE):
            raise ua.uaerrors.BadCommunicationError  # the end of the answer is missing

        def found(place: int, length: float) -> Interval:
            bucket = buckets.get(place, _EMPTY)
            if one.always:
                code = Code.UncertainDataSubNormal if bucket["bad"] else Code.Good
                return code, one.of(bucket, length)
            if bucket["quality"] == "bad":
                return Code.BadNoData, None
            return _code(bucket["quality"] == "good", bucket), one.of(bucket, length)

        return found

    async def _of_samples(
        self, key: str, one: _Aggregate, start: datetime, stop: datetime, width: timedelta
    ) -> Callable[[int, float], Interval]:
        good: Mapping[int, list[Known]] = defaultdict(list)
        bad, count = set[int](), 0
        async for page, lost in self._plant.past(key, f"[{_text(start)}..{_text(stop)}["):
            if lost is not None:
                raise ua.uaerrors.BadDataLost
            count += len(page)
            if count > MOST_SAMPLES:
                raise ua.uaerrors.BadTooManyOperations
            for known in page:
                place = (datetime.fromisoformat(known["time"]) - start) // width
                if known["quality"] == "good":
                    good[place].append(known)
                else:
                    bad.add(place)

        def found(place: int, _: float) -> Interval:
            if not (samples := good.get(place)):
                return Code.BadNoData, None
            return _code(place not in bad, samples[0]), one.of([one["value"] for one in samples])

        return found


def _intervals(
    details: ua.ReadProcessedDetails, point: bytes | None
) -> tuple[datetime, datetime, timedelta]:
    """Returns start, end and the length of an interval. Raises `ua.UaError`."""
    try:
        start, end = (one.astimezone(UTC) for one in (details.StartTime, details.EndTime))
        width = timedelta(milliseconds=details.ProcessingInterval) or end - start
    except (AttributeError, OverflowError, ValueError):
        raise ua.uaerrors.BadInvalidTimestampArgument from None
    if not start < end or width < timedelta(milliseconds=1):  # or a range that runs backwards
        raise ua.uaerrors.BadInvalidArgument
    if point:
        try:
            start = datetime.fromisoformat(point.decode()).replace(tzinfo=UTC)
        except ValueError:
            raise ua.uaerrors.BadContinuationPointInvalid from None
    return start, end, width


def _code(is_good: bool, known: Known) -> int:
    good = ORIGIN.get(known.get("origin", ""), Code.Good)
    return good if is_good else Code.UncertainDataSubNormal


def _as(value: object, kind: ua.VariantType) -> object:
    """Numbers of a Double, also those of a boolean."""
    return float(value) if kind is Type.Double and isinstance(value, int) else value


def _text(time: datetime) -> str:
    return f"{time:%Y-%m-%dT%H:%M:%S.%fZ}"
