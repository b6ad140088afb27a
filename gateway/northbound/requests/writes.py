"""Writes that come over Zenoh: checked, passed to the plant, answered and audited.

A write has one of three endings: the device acknowledged it, it was certainly not done, or it is
`unclear`. Unclear is the answer whenever neither of the others is certain.
"""

import asyncio
import time
from collections.abc import Callable

import structlog
import zenoh

from gateway.contract import payload
from gateway.contract.interfaces import Plant
from gateway.contract.keys import parse_key
from gateway.contract.parsing import parse_write
from gateway.contract.payload import Failure, GroupResult, Problem, WriteOutcome
from gateway.contract.writers import NotAllowed, Repeated
from gateway.errors import Busy, GatewayError
from gateway.northbound.answering.tag_index import TagIndex
from gateway.northbound.requests.acceptance import Acceptance, Sender, sender
from gateway.northbound.requests.group_writes import GroupWrites
from gateway.tags import Tag, WriteResult
from gateway.values import Value

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

MOST_WAITING = 256  # writes that wait for their lines; more are refused
# Zenoh's clients wait 10 s by default, so the answer must come earlier.
ANSWER_WITHIN = 8.0


class Writes:
    """Bounded: with `MOST_WAITING` writes waiting, the next is refused as busy."""

    def __init__(
        self,
        plant: Plant,
        index: TagIndex,
        audit: Callable[[WriteOutcome], None],
        acceptance: Acceptance,
    ) -> None:
        """`audit` gets every outcome."""
        self._plant = plant
        self._index = index
        self._audit = audit
        self._acceptance = acceptance
        self._groups = GroupWrites(plant, index, audit, acceptance, ANSWER_WITHIN)
        self._waiting = 0

    async def write(
        self, key: str, data: bytes | None, sender: Sender
    ) -> WriteResult | Failure | GroupResult:
        """`key` is the `@set` key as received, wildcards included; `data` its payload.

        The key of a device writes several of its tags.
        """
        if self._index.is_device(device := parse_key(key).target):
            return await self._groups.write(key, device, data, sender)
        by = sender.session
        started = time.monotonic()
        value: Value | None = None
        result: WriteResult | Failure = Failure(
            Problem.UNCLEAR, "the gateway ended before the write"
        )
        refused: Failure | None = None  # instead of `result` in the audit
        self._waiting += 1
        try:
            by, within = self._acceptance.accept(key, data, sender)
            await self._acceptance.kept()
            target = self._target(key)
            if isinstance(target, Failure):
                result = target
            else:
                value = parse_write(data or b"")
                result = await self._write_tag(target, value, within)
        except NotAllowed as error:
            result = Failure(Problem.NOT_ALLOWED, str(error))
        except Repeated as error:
            result = Failure(Problem.UNCLEAR, str(error))
            refused = Failure(Problem.NOT_ALLOWED, str(error))
        except GatewayError as error:
            result = payload.failure(error)
        finally:
            self._waiting -= 1
            took = time.monotonic() - started
            value_key = parse_key(key).target
            self._audit(WriteOutcome(value_key, value, refused or result, time.time_ns(), took, by))
        return result

    async def _write_tag(self, tag: Tag, value: Value, within: float) -> WriteResult | Failure:
        if self._waiting > MOST_WAITING:
            raise Busy(f"{MOST_WAITING} writes are waiting already")
        dialling = self._plant.dialling(tag.device)
        longest = ANSWER_WITHIN + dialling
        try:
            async with asyncio.timeout(longest):
                return await self._plant.write(tag, value, within + dialling)
        except TimeoutError:
            why = f"not acknowledged within {longest:g} s: it may yet be done"
            return Failure(Problem.UNCLEAR, why)

    def _target(self, key: str) -> Tag | Failure:
        value_key = parse_key(key).target
        if "*" in key:
            return Failure(
                Problem.UNKNOWN_TAG, f"{key} has a wildcard: a write names one tag, in full"
            )
        tag = self._index.tag_at(value_key)
        if tag is None:
            return Failure(Problem.UNKNOWN_TAG, f"there is no tag at {value_key}")
        if tag.write is None:
            return Failure(
                Problem.NOT_WRITABLE, f"{tag.key} may only be read: the file gives it no `write`"
            )
        return tag


class PutWrites:
    """Writes by a plain put. A put has no reply, so the outcome is only audited."""

    def __init__(self, writes: Writes, index: TagIndex) -> None:
        self.refused = 0  # because the inbox was full
        self._writes = writes
        self._index = index
        self._tasks: set[asyncio.Task[object]] = set()

    def take(self, put: zenoh.Sample, at: float) -> None:
        """Called on the event loop. `at`: when the put arrived."""
        key = str(put.key_expr)
        if "*" not in key and not self._index.owns(parse_key(key).target):
            return  # for another gateway
        work = self._writes.write(key, _payload(put), sender(put, at))
        task: asyncio.Task[object] = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._ended)

    def refuse(self, _put: zenoh.Sample) -> None:
        """Called on Zenoh's thread when the inbox is full."""
        self.refused += 1

    def close(self) -> None:
        for task in self._tasks:
            task.cancel()

    def _ended(self, task: asyncio.Task[object]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()):
            log.error("write crashed", exc_info=error)


def _payload(put: zenoh.Sample) -> bytes | None:
    """None for a delete, which is refused as an empty write."""
    return None if put.kind == zenoh.SampleKind.DELETE else put.payload.to_bytes()
