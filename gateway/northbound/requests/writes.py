"""Writes that come over Zenoh: checked, passed to the plant, answered and audited.

A write has one of three endings: the device acknowledged it, it was certainly not done, or it is
`unclear`. Unclear is the answer whenever neither of the others is certain.

The key of a tag writes this tag, that of a device several of its tags: all are checked before the
first byte is sent. They are sent in their order. After the first that is not done the others are
not sent.
"""

import asyncio
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import structlog
import zenoh

from gateway.contract import payload
from gateway.contract.interfaces import Plant
from gateway.contract.keys import Keys, parse_key
from gateway.contract.parsing import parse_group, parse_write, parsed
from gateway.contract.payload import GroupResult, WriteOutcome
from gateway.contract.problems import Failure, Problem
from gateway.engine.jobs.requests import WRITE_EXPIRY
from gateway.errors import BadValue, Busy, GatewayError, Unknown
from gateway.northbound.answering.tag_index import TagIndex
from gateway.northbound.requests.acceptance import Acceptance, Sender, sender
from gateway.northbound.requests.audit import Audit
from gateway.tags import Tag, WriteResult
from gateway.values import Value

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

MOST_WAITING = 256  # writes that wait for their lines; more are refused
# Zenoh's clients wait 10 s by default, so the answer must come earlier.
ANSWER_WITHIN = 8.0
_ENDED = Failure(Problem.UNCLEAR, "the gateway ended before the write")


@dataclass(slots=True)
class _Asked:
    """One tag of a write, as the client named it."""

    name: str
    key: str
    value: Value | BadValue
    result: WriteResult | Failure = _ENDED


def _asked(key: str, data: bytes, *, is_group: bool) -> list[_Asked]:
    """Raises `BadValue` and `Unknown`."""
    target = parse_key(key).target
    if is_group:
        return [_Asked(name, f"{target}/{name}", value) for name, value in parse_group(data)]
    if "*" in key:
        raise Unknown(f"{key} has a wildcard: a write names one tag, in full")
    return [_Asked(target, target, parsed(parse_write, data))]


@dataclass(eq=False)
class Writes:
    """Bounded: with `MOST_WAITING` writes waiting, the next is refused as busy."""

    _plant: Plant
    _index: TagIndex
    _audit: Callable[[WriteOutcome], None]  # gets the outcome of each tag
    _acceptance: Acceptance
    _waiting: int = 0

    async def write(
        self, key: str, data: bytes | None, sender: Sender
    ) -> WriteResult | Failure | GroupResult:
        """`key` is the `@set` key as received, wildcards included; `data` its payload."""
        by, started = sender.session, time.monotonic()
        target = parse_key(key).target
        is_group = self._index.is_device(target)
        asked: list[_Asked] = []
        whole = told = _ENDED  # for the client, and for the audit
        self._waiting += 1
        try:
            by, within = self._acceptance.accept(key, data, sender)
            await self._acceptance.kept()
            if self._waiting > MOST_WAITING:
                raise Busy(f"{MOST_WAITING} writes are waiting already")
            asked = _asked(key, data or b"", is_group=is_group)
            await self._write(asked, self._checked(asked), within)
        except GatewayError as error:
            whole, told = payload.failure(error), payload.audited(error)
            for one in asked:
                one.result = whole
        finally:
            self._waiting -= 1
            took, at = time.monotonic() - started, time.time_ns()
            for one in asked:
                value = None if isinstance(one.value, BadValue) else one.value
                self._audit(WriteOutcome(one.key, value, one.result, at, took, by))
            if not asked:
                self._audit(WriteOutcome(target, None, told, at, took, by))
        if not asked:
            return whole
        results = {one.name: one.result for one in asked}
        return GroupResult(results, took) if is_group else results[target]

    def _checked(self, asked: Sequence[_Asked]) -> list[tuple[Tag, Value]]:
        """Returns the tags and their values; empty if one is wrong. Each then has its failure."""
        names = [one.name for one in asked]
        found: list[tuple[Tag, Value]] = []
        wrong: list[_Asked] = []
        for one in asked:
            fault = self._fault(one)
            if names.count(one.name) > 1:
                fault = Failure(Problem.BAD_VALUE, "named twice")
            if isinstance(fault, Failure):
                one.result = fault
                wrong.append(one)
            else:
                found.append(fault)
        if not wrong:
            return found
        for one in asked:
            if one not in wrong:
                reason = f"not sent, because {wrong[0].name} is wrong"
                one.result = Failure(Problem.NOT_SENT, reason)
        return []

    def _fault(self, one: _Asked) -> tuple[Tag, Value] | Failure:
        """Returns tag and value, or why the value cannot be written to it."""
        tag = self._index.tag_at(one.key)
        if tag is None:
            return Failure(Problem.UNKNOWN_TAG, f"there is no tag at {payload.short(one.key)}")
        if tag.write is None:
            reason = f"{tag.key} may only be read: the file gives it no `write`"
            return Failure(Problem.NOT_WRITABLE, reason)
        try:
            if isinstance(one.value, BadValue):
                raise one.value
            tag.encode(one.value)
        except BadValue as error:
            return Failure(Problem.BAD_VALUE, str(error))
        return tag, one.value

    async def _write(
        self, asked: Sequence[_Asked], values: Sequence[tuple[Tag, Value]], within: float
    ) -> None:
        if not values:
            return
        dialling = self._plant.dialling(values[0][0].device)
        patience = ANSWER_WITHIN + dialling
        ends = await self._plant.write_group(values, within + dialling, patience)
        for one, end in zip(asked, ends, strict=True):
            one.result = payload.failure(end) if isinstance(end, GatewayError) else end


@dataclass(eq=False)
class OwnWrites:
    """Writes of the parts: the rules and audit of a client's write."""

    _keys: Keys
    _plant: Plant
    _audit: Audit

    async def write(
        self, tag: Tag, value: Value, by: str, within: float, *, repeated: bool = True
    ) -> WriteResult:
        """Returns when the device has acknowledged. After `within` seconds nothing is sent.

        `repeated`: it may come each second for years. Raises `GatewayError`.
        """
        started, now = time.monotonic(), asyncio.get_running_loop().time()
        dialling = self._plant.dialling(tag.device)
        ended: WriteResult | Failure = _ENDED
        try:
            if why := self._plant.duty.why_not(now, now):
                raise Busy(why)
            within = min(within, WRITE_EXPIRY + dialling)
            ends = await self._plant.write_group([(tag, value)], within, ANSWER_WITHIN + dialling)
            if isinstance(end := ends[0], GatewayError):
                raise end
            ended = end
        except GatewayError as error:
            ended = payload.failure(error)
            raise
        finally:
            took, key = time.monotonic() - started, self._keys.value(tag.key)
            tell = self._audit.of_transfer if repeated else self._audit
            tell(WriteOutcome(key, value, ended, time.time_ns(), took, by))
        return ended

    def deny(self, tag: Tag, value: Value | None, by: str, why: str) -> None:
        """Audits a write that is not carried out."""
        key, ended = self._keys.value(tag.key), Failure(Problem.NOT_WRITABLE, why)
        self._audit(WriteOutcome(key, value, ended, time.time_ns(), 0.0, by))


@dataclass(eq=False)
class PutWrites:
    """Writes by a plain put. A put has no reply, so the outcome is only audited."""

    _writes: Writes
    _index: TagIndex
    refused: int = 0  # because the inbox was full
    _tasks: set[asyncio.Task[object]] = field(default_factory=set)

    def take(self, put: zenoh.Sample, at: float) -> None:
        """Called on the event loop. `at`: when the put arrived."""
        key = str(put.key_expr)
        if "*" not in key and not self._index.owns(parse_key(key).target):
            return  # for another gateway
        # A delete is refused as an empty write.
        data = None if put.kind == zenoh.SampleKind.DELETE else put.payload.to_bytes()
        work = self._writes.write(key, data, sender(put, at))
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
