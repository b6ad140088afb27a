"""Samples of the history, page by page."""

from collections.abc import AsyncIterator

import orjson
import zenoh

from gateway.bridges.documents import Known, copied
from gateway.bridges.remote_plant import RemotePlant
from gateway.errors import GatewayError

PAGE = 10_000  # samples


async def past(plant: RemotePlant, key: str, bounds: str) -> AsyncIterator[list[Known]]:
    """Yields the samples of a tag in a range of `_time`.

    Only the end of a page tells whether all of it has arrived. Raises `GatewayError` where it has
    not.
    """
    after, is_complete = "", False
    while not is_complete:
        replies = await plant.requests.ask(
            f"{key}?_time={bounds};page={PAGE}{after}", accept_replies=zenoh.ReplyKeyExpr.ANY
        )
        *found, last = [reply.ok for reply in replies] or [None]
        if last is None or not str(last.key_expr).endswith("/page"):
            raise GatewayError("no gateway has answered")
        page = orjson.loads(last.payload.to_bytes())
        read = [plant.read(key, *copied(sample)[1:]) for sample in found if sample]
        if page["samples"] != len(read):
            raise GatewayError("not all samples have arrived")
        yield [known for known in read if known]
        is_complete = page["complete"]
        after = f";after={page['next']}"
