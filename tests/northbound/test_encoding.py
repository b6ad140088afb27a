"""Raw payloads: the bare value as text, quality and time in the attachment."""

import json
import math
import time
from typing import Any

import pytest

from gateway.contract import payload
from gateway.tags import Form, Reason, bad, good
from tests.northbound.plant import PlainDevice, PlainPlant, gateway_and_client, tag

NONE = "NONE"  # Zenoh's consolidation that streams


async def test_a_raw_value_is_plain_text_with_its_quality_in_the_attachment() -> None:
    raw = PlainPlant(PlainDevice("mixer", (tag("mixer", "speed", payload=Form.RAW),)))
    async with gateway_and_client(raw) as (northbound, client):
        received = await client.subscribe("plant/**")
        northbound.publish([raw.now("mixer/speed", 12)])
        arrived = await received.next(lambda sample: sample.payload == b"12")
        assert (arrived.kind, arrived.encoding) == ("PUT", "text/plain")
        attachment = json.loads(arrived.attachment)
        assert set(attachment) == {"quality", "time"}
        assert attachment["quality"] == "good"
        [reply] = await client.get("plant/mixer/speed")
        assert (reply.payload, reply.encoding) == (b"12", "text/plain")
        # An unknown value has no text that a reader could mistake for a value.
        received.forget()
        speed = raw.tag("mixer/speed")
        assert speed is not None
        raw.samples["mixer/speed"] = bad(speed, Reason.NO_REPLY, time.time_ns())
        northbound.publish([raw.samples["mixer/speed"]])
        deleted = await received.next(lambda sample: True)
        assert (deleted.kind, deleted.payload) == ("DELETE", b"")
        attachment = json.loads(deleted.attachment)
        assert (attachment["quality"], attachment["reason"]) == ("bad", "no-reply")
        [reply] = await client.get("plant/mixer/speed")
        assert (reply.ok, reply.payload) == (True, b"")
        [described] = await client.get("plant/mixer/speed/@meta")
        assert described.json["payload"] == "raw"


@pytest.mark.parametrize(
    ("value", "text"),
    [(True, b"true"), (False, b"false"), (-7, b"-7"), (12.5, b"12.5"), ("Ä 1", "Ä 1".encode()),
     (2**63, b"9223372036854775808"), (math.nan, None), (math.inf, None), (None, None)],
)  # fmt: skip
def test_the_text_of_a_raw_value(value: Any, text: bytes | None) -> None:
    sample = good(tag("mixer", "speed"), value, 0)
    assert payload.value_text(sample) == text
    assert (json.loads(payload.attachment(sample))["quality"] == "good") == (text is not None)
