"""Several tags of one device in one write: all are checked before the first byte is sent.

They are sent in their order. After the first that is not done the others are not sent.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from gateway.contract import payload
from gateway.contract.interfaces import Plant
from gateway.contract.parsing import parse_group
from gateway.contract.payload import Failure, GroupResult, Problem, WriteOutcome
from gateway.contract.writers import NotAllowed, Repeated
from gateway.errors import BadValue, Busy, GatewayError
from gateway.northbound.answering.tag_index import TagIndex
from gateway.northbound.requests.acceptance import Acceptance, Sender
from gateway.tags import Tag, WriteResult
from gateway.values import Value

MOST_WAITING = 256  # groups that wait for their lines; more are refused
_ENDED = Failure(Problem.UNCLEAR, "the gateway ended before the write")


@dataclass(slots=True)
class _Asked:
    """One tag of a group, as the client named it."""

    name: str
    value: Value | None  # None: it is none
    result: WriteResult | Failure = _ENDED


class GroupWrites:
    """Bounded: with `MOST_WAITING` groups waiting, the next is refused as busy."""

    def __init__(
        self,
        plant: Plant,
        index: TagIndex,
        audit: Callable[[WriteOutcome], None],
        acceptance: Acceptance,
        patience: float,
    ) -> None:
        """`audit` gets the outcome of each tag. `patience`: seconds until the answer."""
        self._plant = plant
        self._index = index
        self._audit = audit
        self._acceptance = acceptance
        self._patience = patience
        self._waiting = 0

    async def write(
        self, key: str, device: str, data: bytes | None, sender: Sender
    ) -> GroupResult | Failure:
        """`key` is the `@set` key as received; `device`: the same without `@set`."""
        by, started = sender.session, time.monotonic()
        asked: list[_Asked] = []
        whole = _ENDED
        refused: Failure | None = None  # instead of `whole` in the audit
        self._waiting += 1
        try:
            by, within = self._acceptance.accept(key, data, sender)
            await self._acceptance.kept()
            self._check_room()
            pairs = parse_group(data or b"")
            for name, value in pairs:
                asked.append(_Asked(name, None if isinstance(value, BadValue) else value))
            await self._write(asked, self._checked(device, pairs, asked), within)
        except NotAllowed as error:
            whole = Failure(Problem.NOT_ALLOWED, str(error))
        except Repeated as error:
            whole = Failure(Problem.UNCLEAR, str(error))
            refused = Failure(Problem.NOT_ALLOWED, str(error))
        except GatewayError as error:
            whole = payload.failure(error)
            for one in asked:
                one.result = whole
        finally:
            self._waiting -= 1
            took, at = time.monotonic() - started, time.time_ns()
            for one in asked:
                where = f"{device}/{one.name}"
                self._audit(WriteOutcome(where, one.value, one.result, at, took, by))
            if not asked:
                self._audit(WriteOutcome(device, None, refused or whole, at, took, by))
        return GroupResult({one.name: one.result for one in asked}, took) if asked else whole

    def _check_room(self) -> None:
        if self._waiting > MOST_WAITING:
            raise Busy(f"{MOST_WAITING} groups are waiting already")

    def _checked(
        self, device: str, pairs: Sequence[tuple[str, Value | BadValue]], asked: Sequence[_Asked]
    ) -> list[tuple[Tag, Value]]:
        """Returns the tags and their values; empty if one is wrong. Each then has its failure."""
        names = [name for name, _ in pairs]
        found: list[tuple[Tag, Value]] = []
        wrong: list[str] = []
        for (name, value), one in zip(pairs, asked, strict=True):
            fault = self._fault(f"{device}/{name}", value)
            if names.count(name) > 1:
                fault = Failure(Problem.BAD_VALUE, "named twice")
            if isinstance(fault, Failure):
                one.result = fault
                wrong.append(name)
            elif not isinstance(value, BadValue):
                found.append((fault, value))
        if not wrong:
            return found
        for one in asked:
            if one.name not in wrong:
                one.result = Failure(Problem.NOT_SENT, f"not sent, because {wrong[0]} is wrong")
        return []

    def _fault(self, key: str, value: Value | BadValue) -> Tag | Failure:
        """Returns the tag at the key, or why the value cannot be written to it."""
        tag = self._index.tag_at(key)
        if tag is None:
            return Failure(Problem.UNKNOWN_TAG, f"there is no tag at {payload.short(key)}")
        if tag.write is None:
            return Failure(
                Problem.NOT_WRITABLE, "it may only be read: the file gives it no `write`"
            )
        try:
            if isinstance(value, BadValue):
                raise value
            tag.encode(value)
        except BadValue as error:
            return Failure(Problem.BAD_VALUE, str(error))
        return tag

    async def _write(
        self, asked: Sequence[_Asked], values: Sequence[tuple[Tag, Value]], within: float
    ) -> None:
        if not values:
            return
        dialling = self._plant.dialling(values[0][0].device)
        patience = self._patience + dialling
        ends = await self._plant.write_group(values, within + dialling, patience)
        for one, end in zip(asked, ends, strict=True):
            one.result = payload.failure(end) if isinstance(end, GatewayError) else end
