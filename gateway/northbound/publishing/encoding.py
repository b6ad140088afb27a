"""Samples on Zenoh: the JSON of the contract, or the bare value (`payload: raw`).

Raw is the value as UTF-8 text, `text/plain`: `12.5`, `true`, `AB`. Quality and time are in the
attachment. An unknown value has no text that a reader could mistake for a value: it is a DELETE of
the key, with the reason in the attachment.
"""

from typing import Any

import orjson
import zenoh

from gateway.contract import payload
from gateway.tags import Form, Sample
from gateway.tags.sample import has_json
from gateway.tags.scan import Samples

_DROP = {"congestion_control": zenoh.CongestionControl.DROP}
# Below the priority of answers. A long answer over a slow link waits for room in the queue of its
# priority, and Zenoh makes everybody wait who sends in that priority: the publisher, for all links.
_LOW: dict[str, Any] = {**_DROP, "priority": zenoh.Priority.DATA_LOW}
# Alarms and outcomes go before answers and values, in a queue of their own on each link.
_URGENT: dict[str, Any] = {**_DROP, "priority": zenoh.Priority.INTERACTIVE_HIGH}
_JSON = zenoh.Encoding.APPLICATION_JSON
_TEXT = zenoh.Encoding.TEXT_PLAIN
_JSON_FORM = Form.JSON  # looking up a member of an enumeration takes 0.2 µs


def scan(samples: Samples) -> list[bytes | Sample]:
    """Returns the JSON of each plain good value of a read, or the sample of any other."""
    values, others = samples.plain()
    text, end = orjson.dumps(values), payload.end_of_good(samples.time)
    joint = b'%b\n{"value":' % end  # JSON has no line end within a value
    found: list[bytes | Sample] = []
    found += (b'{"value":%b%b' % (text[1:-1].replace(b",", joint), end)).split(b"\n")
    if len(found) != len(samples):  # a comma within a value
        return list(samples)
    if b"null" in text:
        others = [place for place, known in enumerate(values) if not has_json(known)]
    for place in others:
        found[place] = samples[place]
    return found


def put(session: zenoh.Session, key: str, sample: Sample, stamp: zenoh.Timestamp | None) -> None:
    """Raises `ZError`."""
    if sample.tag.publishing.payload is _JSON_FORM:
        put_json(session, key, payload.value(sample), stamp)
        return
    text, attachment = payload.value_text(sample), payload.attachment(sample)
    if text is None:
        session.delete(key, timestamp=stamp, attachment=attachment, **_LOW)
        return
    session.put(key, text, encoding=_TEXT, timestamp=stamp, attachment=attachment, **_LOW)


def put_json(
    session: zenoh.Session,
    key: str,
    data: bytes,
    stamp: zenoh.Timestamp | None,
    attachment: bytes | None = None,
    *,
    urgent: bool = False,
) -> None:
    """Raises `ZError`."""
    how = _URGENT if urgent else _LOW
    session.put(key, data, encoding=_JSON, timestamp=stamp, attachment=attachment, **how)


def reply(query: zenoh.Query, key: str, sample: Sample, stamp: zenoh.Timestamp) -> None:
    """Raises `ZError`."""
    if sample.tag.publishing.payload is _JSON_FORM:
        reply_json(query, key, payload.value(sample), stamp)
        return
    text, attachment = payload.value_text(sample), payload.attachment(sample)
    if text is None:
        query.reply_del(key, timestamp=stamp, attachment=attachment)
        return
    query.reply(key, text, encoding=_TEXT, timestamp=stamp, attachment=attachment)


def reply_json(query: zenoh.Query, key: str, data: bytes, stamp: zenoh.Timestamp) -> None:
    """Raises `ZError`."""
    query.reply(key, data, encoding=_JSON, timestamp=stamp)
