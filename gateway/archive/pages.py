"""Pages of a gateway's history, in the order of recording."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import orjson
import zenoh

from gateway.archive.rows import Row, row_of
from gateway.bridges.documents import is_name, is_value
from gateway.bridges.requests import Requests
from gateway.errors import GatewayError

ANSWER_WITHIN = 60.0  # seconds: a gateway works for five, the link may need longer
# Every value goes first. An answer waits in the gateway until there is room.
_LOW = zenoh.Priority.BACKGROUND


class Page(NamedTuple):
    """Rows, and the place to go on from. `file`: the mark of the history file of the gateway.

    `strange`: replies that are no samples.
    """

    rows: Sequence[Row]
    next: str
    is_last: bool
    is_whole: bool  # everything recorded so far is in it and the pages before
    lost: str | None
    strange: int

    @property
    def file(self) -> str:
        return file_of(self.next)


def file_of(place: str) -> str:
    """Returns the mark of the file in a place such as `demo:1f.a0b1c2d3-4711-12`."""
    return place.rpartition(":")[2].partition("-")[0]


class History:
    """The history of one gateway. `key`: its own, such as `plant/@gateway/demo`."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self.key = key
        self._requests = Requests(session, key)

    async def page(self, after: str, size: int) -> Page:
        """Raises `GatewayError` where not all of it has arrived."""
        since = f";after={after}" if after else ""
        replies = await self._requests.ask(
            f"page?_time=[..];page={size}{since}",
            accept_replies=zenoh.ReplyKeyExpr.ANY,
            priority=_LOW,
            timeout=ANSWER_WITHIN,
        )
        failed = [reply.err for reply in replies if reply.err is not None]
        found = [(str(one.ok.key_expr), one.ok.payload.to_bytes()) for one in replies if one.ok]
        ends = [payload for key, payload in found if key == f"{self.key}/page"]
        if failed or not ends:
            raise GatewayError(_why(failed[0]) if failed else "it does not answer")
        if len(ends) > 1:
            raise GatewayError(f"{len(ends)} gateways have this name: rename one")
        try:
            samples = [
                sample
                for key, payload in found
                if key == f"{self.key}/page/samples"
                for sample in _samples(orjson.loads(payload))
            ]
            end = orjson.loads(ends[0])
            whole, again, place = end["samples"], end.get("again", 0), str(end["next"])
            is_last, lost = bool(end["complete"]), end.get("damaged")
        except (ValueError, TypeError, KeyError):
            raise GatewayError("its answer is none of a gateway") from None
        if len(samples) != whole:
            raise GatewayError(f"{len(samples)} of {whole} samples have arrived")
        if not file_of(place):
            raise GatewayError("its history is not ready")
        samples = samples[: whole - again]
        rows = [row for sample in samples if (row := _row(*sample)) is not None]
        is_whole = is_last and not again
        return Page(rows, place, is_last, is_whole, lost, len(samples) - len(rows))


def _samples(batch: Any) -> Iterator[tuple[object, Any]]:
    return zip(batch["keys"], batch["values"], strict=True)


def _row(key: object, known: Any) -> Row | None:
    """Returns None for what is no sample. Every sample is JSON here, of bare values too."""
    try:
        if isinstance(key, str) and is_name(key) and is_value(known):
            return row_of(key, known)
    except (KeyError, TypeError, ValueError):
        pass
    return None


def _why(error: zenoh.ReplyError) -> str:
    try:
        known = orjson.loads(error.payload.to_bytes())
        return f"{known['error']}: {known['reason']}"
    except (ValueError, TypeError, KeyError):  # Zenoh's own: a time-out
        return "it does not answer in time"
