"""The outcomes of several writes that were submitted together."""

import asyncio
from collections.abc import Sequence

from gateway.errors import GatewayError, Unclear
from gateway.tags import WriteResult


async def ended(
    writes: Sequence[asyncio.Future[WriteResult]], patience: float
) -> list[WriteResult | GatewayError]:
    """Returns the outcomes of `write_group`. What has not ended after `patience` seconds is
    `Unclear`."""
    try:
        await asyncio.wait(writes, timeout=patience)
    finally:
        for write in writes:
            if not write.cancel() and not write.cancelled():
                write.exception()  # seen, also if nothing waits for it any more
    found = list[WriteResult | GatewayError]()
    for write in writes:
        try:
            found.append(write.result())
        except asyncio.CancelledError:
            found.append(not_acknowledged(patience))
        except GatewayError as error:
            found.append(error)
    return found


def not_acknowledged(patience: float) -> Unclear:
    """Returns the outcome of a write that has not ended after so many seconds."""
    return Unclear(f"not acknowledged within {patience:g} s: it may yet be done")
