"""A sample on its way out: the JSON of the contract, or the bare value (`payload: raw`).

Raw is the value as UTF-8 text, `text/plain`: `12.5`, `true`, `AB`. Quality and time are in the
attachment. A value that is not known is no text that somebody could take for one: it is a
DELETE of the key, with the reason in the attachment.
"""

import zenoh

from gateway.northbound import payload
from gateway.tags import Form, Sample

_DROP = zenoh.CongestionControl.DROP
_JSON = zenoh.Encoding.APPLICATION_JSON
_TEXT = zenoh.Encoding.TEXT_PLAIN


def put(session: zenoh.Session, key: str, sample: Sample, stamp: zenoh.Timestamp | None) -> None:
    """Raises `ZError`."""
    if sample.tag.payload is Form.JSON:
        put_json(session, key, payload.value(sample), stamp)
        return
    bare, about = payload.bare(sample), payload.about(sample)
    if bare is None:
        session.delete(key, congestion_control=_DROP, timestamp=stamp, attachment=about)
        return
    session.put(
        key,
        bare,
        encoding=_TEXT,
        congestion_control=_DROP,
        timestamp=stamp,
        attachment=about,
    )


def put_json(session: zenoh.Session, key: str, data: bytes, stamp: zenoh.Timestamp | None) -> None:
    """Raises `ZError`."""
    session.put(
        key,
        data,
        encoding=_JSON,
        congestion_control=_DROP,
        timestamp=stamp,
    )


def reply(query: zenoh.Query, key: str, sample: Sample, stamp: zenoh.Timestamp) -> None:
    """Raises `ZError`."""
    if sample.tag.payload is Form.JSON:
        reply_json(query, key, payload.value(sample), stamp)
        return
    bare, about = payload.bare(sample), payload.about(sample)
    if bare is None:
        query.reply_del(key, timestamp=stamp, attachment=about)
        return
    query.reply(key, bare, encoding=_TEXT, timestamp=stamp, attachment=about)


def reply_json(query: zenoh.Query, key: str, data: bytes, stamp: zenoh.Timestamp) -> None:
    """Raises `ZError`."""
    query.reply(key, data, encoding=_JSON, timestamp=stamp)
