"""A document of all gateways under a prefix, in one query."""

import time
from collections.abc import Iterator

import zenoh

from gateway.contract.keys import Keys
from gateway.errors import GatewayError

MOST_REPLIES, LARGEST = 20_000, 65_536  # of one query, bytes of one reply


def everywhere(
    session: zenoh.Session, keys: Keys, path: str, within: float
) -> Iterator[tuple[str, bytes, float]]:
    """Yields key, payload and arrival (s since 1970) of the document of each gateway. Blocks.

    A gateway that hangs delays the end by `within` seconds, and nothing else. Raises
    `GatewayError` where the session was closed.
    """
    try:
        replies = session.get(
            keys.everywhere(path), timeout=within, consolidation=zenoh.ConsolidationMode.NONE
        )
    except zenoh.ZError as error:
        raise GatewayError(f"Zenoh takes no query: {error}") from None
    for count, reply in enumerate(replies):
        if count == MOST_REPLIES:
            return
        if reply.ok is not None and len(reply.ok.payload) <= LARGEST:
            yield str(reply.ok.key_expr), reply.ok.payload.to_bytes(), time.time()
