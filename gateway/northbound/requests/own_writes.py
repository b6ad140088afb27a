"""Writes of the gateway itself, for its transfers: the rules and the audit of a client's write."""

import asyncio
import time

from gateway.contract import payload
from gateway.contract.interfaces import Plant
from gateway.contract.keys import Keys
from gateway.contract.payload import Failure, Problem, WriteOutcome
from gateway.engine.jobs.requests import WRITE_EXPIRY
from gateway.errors import Busy, GatewayError, Unclear
from gateway.northbound.requests.audit import Audit
from gateway.northbound.requests.writes import ANSWER_WITHIN
from gateway.tags import Tag, WriteResult
from gateway.values import Value


class OwnWrites:
    """Writes a value that needs no parsing. Each outcome is audited."""

    def __init__(self, keys: Keys, plant: Plant, audit: Audit) -> None:
        self._keys = keys
        self._plant = plant
        self._audit = audit

    async def write(self, tag: Tag, value: Value, by: str, within: float) -> WriteResult:
        """Returns when the device has acknowledged. After `within` seconds nothing is sent.

        Raises `GatewayError`, as `Plant.write` does.
        """
        started, now = time.monotonic(), asyncio.get_running_loop().time()
        dialling = self._plant.dialling(tag.device)
        ended: WriteResult | Failure = Failure(
            Problem.UNCLEAR, "the gateway ended before the write"
        )
        try:
            if why := self._plant.duty.why_not(now, now):
                raise Busy(why)
            async with asyncio.timeout(ANSWER_WITHIN + dialling):
                within = min(within, WRITE_EXPIRY + dialling)
                ended = await self._plant.write(tag, value, within)
        except TimeoutError:
            longest = ANSWER_WITHIN + dialling
            error = Unclear(f"not acknowledged within {longest:g} s: it may yet be done")
            ended = payload.failure(error)
            raise error from None
        except GatewayError as error:
            ended = payload.failure(error)
            raise
        finally:
            took, key = time.monotonic() - started, self._keys.value(tag.key)
            outcome = WriteOutcome(key, value, ended, time.time_ns(), took, by)
            self._audit.of_transfer(outcome)
        return ended
