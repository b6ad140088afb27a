"""Buckets of history as JSON, on Zenoh and HTTP alike.

`{"time": "2026-11-20T12:00:00.000000Z", "quality": "good", "min": 1.5, "max": 3.0, "mean": 2.25,
"last": 3.0, "good": 12, "bad": 0, "known": 60.0}`: `time` is the beginning, `known` the seconds
with a valid value. A bucket with a gap is `partial` or `bad`, with a `reason`. One without a valid
value has null for all values. `origin` as in a value.
"""

from collections.abc import Sequence

import orjson

from gateway.contract.past.buckets import Bucket
from gateway.tags import Tag
from gateway.tags.timestamps import rfc3339


def fields(tag: Tag, bucket: Bucket, aggregates: Sequence[str]) -> dict[str, object]:
    values = bucket._asdict()
    found: dict[str, object] = {"time": rfc3339(bucket.time), "quality": bucket.quality}
    found |= {name: values[name] for name in aggregates}
    found |= {"good": bucket.good, "bad": bucket.bad, "known": round(bucket.known / 1e9, 6)}
    if bucket.quality != "good":
        found["reason"] = bucket.reason
    if (origin := tag.origin.word) is not None:
        found["origin"] = origin
    return found


def document(tag: Tag, bucket: Bucket, aggregates: Sequence[str]) -> bytes:
    return orjson.dumps(fields(tag, bucket, aggregates))
