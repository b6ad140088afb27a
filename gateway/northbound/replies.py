"""Replies to queries, made on an answering thread: values, descriptions, status, outcomes."""

from collections.abc import Callable, Sequence

import zenoh

from gateway.errors import BadValue, Busy, GatewayError
from gateway.northbound import encoding, payload
from gateway.northbound.interfaces import History, Plant
from gateway.northbound.keys import Family, Keys, ParsedKey
from gateway.northbound.payload import Failure, Problem
from gateway.northbound.tag_index import TagIndex
from gateway.tags import Tag, WriteResult

_INCOMPLETE = "the gateway is ending: this is not all"
_NO_HISTORY = Failure(Problem.NO_HISTORY, "no history is kept here: ask without _time")


class Replies:
    """Every method replies to one query and may block while the client does not receive.

    `stamp` makes the session's time stamps. Each reply has its own, because an AdvancedSubscriber
    keeps only one of several samples with equal stamps.
    """

    def __init__(
        self,
        keys: Keys,
        plant: Plant,
        index: TagIndex,
        stamp: Callable[[], zenoh.Timestamp],
        history: History | None = None,
    ) -> None:
        self._keys = keys
        self._plant = plant
        self._index = index
        self._stamp = stamp
        self._history = history
        self._ended = False
        self._only_blocks = {d.name for d in index.devices if d.blocks == "only"}

    def end(self) -> None:
        """Makes a long answer stop at the next tag."""
        self._ended = True

    def current(self, parsed: ParsedKey, query: zenoh.Query) -> None:
        if parsed.family is Family.BLOCK:
            for device in self._index.devices_at(parsed.target):
                if device.blocks:
                    stamp = self._stamp()
                    block = payload.block(self._plant.sample(tag) for tag in device.tags)
                    self._reply(query, self._keys.block(device.name), block, stamp)
            return
        for tag in self._index.tags_at(parsed.target):
            if self._ended:
                return
            if parsed.family is Family.LAST and tag.device in self._only_blocks:
                continue  # a subscriber would wait for this key, which is never put
            if parsed.family is Family.META:
                self._reply(query, self._keys.meta(tag.key), payload.meta(tag), self._stamp())
            else:
                self._value(query, tag)

    def _value(self, query: zenoh.Query, tag: Tag) -> None:
        # Stamped before the look-up: a newer value that is put meanwhile has the newer stamp.
        stamp = self._stamp()
        sample = self._plant.sample(tag)
        encoding.reply(query, self._keys.value(tag.key), sample, stamp)

    def fresh(self, tags: Sequence[Tag], unread: Sequence[Tag], query: zenoh.Query) -> None:
        """Replies with current values, and with one error for all tags in `unread`."""
        for tag in tags:
            if tag not in unread:
                self._value(query, tag)
        if unread:
            more = f" and {len(unread) - 1} more" if len(unread) > 1 else ""
            reason = f"{unread[0].key}{more} could not be read in time"
            self.outcome(Failure(Problem.BUSY, reason), query)

    def history(self, parsed: ParsedKey, now: int, query: zenoh.Query) -> None:
        """`now`: ns since 1970, when the query was taken."""
        tags = self._index.tags_at(parsed.target)
        if self._history is None:
            if tags:  # otherwise they are another gateway's, which may have a history
                self.outcome(_NO_HISTORY, query)
            return
        try:
            limit = _limit(query.parameters.get("limit"))
            time_range = query.parameters.get("_time") or ""
            for tag in tags:
                key = self._keys.value(tag.key)
                for sample in self._history.samples(tag, time_range, limit, now):
                    if self._ended:
                        raise Busy(_INCOMPLETE)
                    encoding.reply(query, key, sample, self._stamp())
        except BadValue as error:
            self.outcome(Failure(Problem.BAD_QUERY, str(error)), query)
        except GatewayError as error:
            self.outcome(payload.failure(error), query)

    def writes(self, now: int, query: zenoh.Query) -> None:
        """Replies with recorded outcomes, on the key of their publication. `now` as in
        `history`."""
        if not query.key_expr.intersects(self._keys.writes):
            return
        if self._history is None:
            self.outcome(_NO_HISTORY, query)
            return
        try:
            limit = _limit(query.parameters.get("limit"))
            time_range = query.parameters.get("_time") or ""
            for outcome in self._history.writes(time_range, limit, now):
                if self._ended:
                    raise Busy(_INCOMPLETE)
                self._reply(query, self._keys.writes, outcome.encode(), self._stamp())
        except BadValue as error:
            self.outcome(Failure(Problem.BAD_QUERY, str(error)), query)
        except GatewayError as error:
            self.outcome(payload.failure(error), query)

    def status(self, documents: dict[str, bytes], query: zenoh.Query) -> None:
        for key, document in documents.items():
            if query.key_expr.intersects(key):
                self._reply(query, key, document, self._stamp())

    def outcome(self, result: WriteResult | Failure, query: zenoh.Query) -> None:
        data = payload.outcome(result)
        if isinstance(result, Failure):
            query.reply_err(data, encoding=zenoh.Encoding.APPLICATION_JSON)
        else:
            self._reply(query, str(query.key_expr), data, self._stamp())

    def _reply(self, query: zenoh.Query, key: str, data: bytes, stamp: zenoh.Timestamp) -> None:
        encoding.reply_json(query, key, data, stamp)


def _limit(text: str | None) -> int | None:
    if text is None:
        return None
    if not (text.isascii() and text.isdigit() and len(text) <= 9):
        raise BadValue(f"limit={text[:40]} is no count such as 100")
    return int(text)
