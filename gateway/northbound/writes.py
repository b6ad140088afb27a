"""Writes that come over Zenoh: checked, handed down, and every outcome told.

Whatever happens between a request and the device's acknowledgement has one of three endings: it
was acknowledged, it was certainly not done, or nobody can say (`unclear`). The last is what is
answered whenever nothing better is known.
"""

import asyncio
import time
from collections.abc import Callable

import structlog
import zenoh

from gateway.errors import Busy, GatewayError
from gateway.northbound import payload
from gateway.northbound.directory import Directory
from gateway.northbound.keys import Keys, asked
from gateway.northbound.payload import Failure, Problem, WriteOutcome
from gateway.northbound.plant import Plant
from gateway.northbound.writers import LONGEST_TOKEN, Asker, NotAllowed, Writers
from gateway.tags import Tag, WriteResult
from gateway.values import Value

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

AT_ONCE = 256  # writes that wait for their lines; more are refused
# Zenoh's clients wait 10 s if they say nothing else: they must hear before that.
ANSWER_WITHIN = 8.0


class Writes:
    """Bounded: beyond `AT_ONCE` waiting writes the next is refused as busy."""

    def __init__(
        self,
        keys: Keys,
        plant: Plant,
        directory: Directory,
        wrote: Callable[[WriteOutcome], None],
        writers: Writers | None = None,
    ) -> None:
        self._keys = keys
        self._plant = plant
        self._directory = directory
        self._wrote = wrote
        self._writers = writers
        self._waiting = 0

    async def write(self, key: str, data: bytes | None, asker: Asker) -> WriteResult | Failure:
        """`key` is the `@set` key as it came, wildcards and all; `data` its payload."""
        by = asker.session
        started = time.monotonic()
        value: Value | None = None
        result: WriteResult | Failure = Failure(
            Problem.UNCLEAR, "the gateway ended before the write"
        )
        self._waiting += 1
        try:
            if self._writers is not None:
                by = self._writers.owner(asker.token)
            target = self._target(key)
            if isinstance(target, Failure):
                result = target
            else:
                value = payload.wanted(data or b"")
                result = await self._hand_down(target, value)
        except TimeoutError:
            result = Failure(
                Problem.UNCLEAR, f"not acknowledged within {ANSWER_WITHIN:g} s: it may yet be done"
            )
        except NotAllowed as error:
            result = Failure(Problem.NOT_ALLOWED, str(error))
        except GatewayError as error:
            result = payload.failure(error)
        finally:
            self._waiting -= 1
            took = time.monotonic() - started
            self._wrote(WriteOutcome(asked(key).of, value, result, time.time_ns(), took, by))
        return result

    async def _hand_down(self, tag: Tag, value: Value) -> WriteResult:
        if self._waiting > AT_ONCE:
            raise Busy(f"{AT_ONCE} writes are waiting already")
        async with asyncio.timeout(ANSWER_WITHIN):
            return await self._plant.write(tag, value)

    def _target(self, key: str) -> Tag | Failure:
        value_key = asked(key).of
        if "*" in key:
            return Failure(
                Problem.UNKNOWN_TAG, f"{key} has a wildcard: a write names one tag, in full"
            )
        tag = self._directory.one(value_key)
        if tag is None:
            return Failure(Problem.UNKNOWN_TAG, f"there is no tag at {value_key}")
        if tag.write is None:
            return Failure(
                Problem.NOT_WRITABLE, f"{tag.key} may only be read: the file gives it no `write`"
            )
        return tag


class PutWrites:
    """Writes by a plain put: nobody can be answered, so the outcome is only told and logged."""

    def __init__(self, writes: Writes, directory: Directory) -> None:
        self.refused = 0  # for want of room
        self._writes = writes
        self._directory = directory
        self._tasks: set[asyncio.Task[object]] = set()

    def take(self, put: zenoh.Sample) -> None:
        """On the event loop."""
        key = str(put.key_expr)
        if "*" not in key and not self._directory.owns(asked(key).of):
            return  # another gateway's
        work = self._writes.write(key, _payload(put), asker(put))
        task: asyncio.Task[object] = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._ended)

    def refuse(self, _put: zenoh.Sample) -> None:
        """On Zenoh's thread, for want of room."""
        self.refused += 1

    def close(self) -> None:
        for task in self._tasks:
            task.cancel()

    def _ended(self, task: asyncio.Task[object]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()):
            log.error("a write failed", exc_info=error)


def asker(asking: zenoh.Query | zenoh.Sample) -> Asker:
    """Who asked, where Zenoh or a token tells: most clients do not say."""
    source, token = asking.source_info, asking.attachment
    return Asker(
        None if source is None else str(source.source_id.zid),
        None if token is None or len(token) > LONGEST_TOKEN else token.to_bytes(),
    )


def _payload(put: zenoh.Sample) -> bytes | None:
    """None for a delete, which is refused as a write of nothing."""
    return None if put.kind == zenoh.SampleKind.DELETE else put.payload.to_bytes()
