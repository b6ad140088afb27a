"""Commands that come over Zenoh: checked, passed to the plant, answered and audited.

<prefix>/<device>/@run, @stop, @loopback, @model        one device, named in full
<prefix>/@gateway/<name>/lines/<line>/global            all stations of a line: on, off
"""

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass

from gateway.config.commands import TO_ALL, NotControlled
from gateway.contract import payload
from gateway.contract.interfaces import Parts, Plant
from gateway.contract.keys import Keys
from gateway.contract.payload import WriteOutcome
from gateway.contract.problems import Failure, Problem
from gateway.engine.jobs.requests import CommandResult
from gateway.errors import BadValue, GatewayError
from gateway.northbound.requests.acceptance import Acceptance, Sender
from gateway.northbound.requests.audit import Audit
from gateway.northbound.requests.writes import ANSWER_WITHIN

_LONGEST_ARGUMENT = 1000  # bytes; a loopback takes 254 characters at most


@dataclass(eq=False)
class Commands:
    """Bounded by the open queries and by the requests that may wait for a line."""

    _keys: Keys
    _plant: Plant
    _audit: Callable[[WriteOutcome], None]  # gets every outcome
    _acceptance: Acceptance

    async def execute(
        self, key: str, data: bytes | None, sender: Sender
    ) -> CommandResult | Failure:
        """`key` is as received, wildcards included; `data` is the argument as text."""
        by, argument = sender.session, ""
        started = time.monotonic()
        refused: Failure | None = None  # instead of `result` in the audit
        result: CommandResult | Failure = Failure(Problem.UNCLEAR, "the gateway is ending")
        longest = ANSWER_WITHIN
        try:
            by, within = self._acceptance.accept(key, data, sender)
            await self._acceptance.kept()
            argument = _argument(data)
            device, command = self._target(key)
            dialling = self._plant.dialling(device)
            longest += dialling
            async with asyncio.timeout(longest):
                result = await self._plant.control(device, command, argument, within + dialling)
        except TimeoutError:
            reason = f"not answered within {longest:g} s: it may yet be done"
            result = Failure(Problem.UNCLEAR, reason)
        except NotControlled as error:
            result = Failure(Problem.NOT_WRITABLE, str(error))
        except GatewayError as error:
            result, refused = payload.failure(error), payload.audited(error)
        finally:
            took = time.monotonic() - started
            value = argument or None
            told = refused or result
            self._audit(WriteOutcome(key, value, told, time.time_ns(), took, by, command=True))
        return result

    def _target(self, key: str) -> tuple[str, str]:
        """Returns device and command. Raises `BadValue`."""
        if "*" in key:
            raise BadValue(f"{payload.short(key)} has a wildcard: a command names one, in full")
        if (line := _line_of(key, self._keys.own)) is not None:
            return self._plant.speaker(line), TO_ALL
        stem, _, last = key.rpartition("/")
        return self._keys.tag(stem) or stem, last.removeprefix("@")


def _argument(data: bytes | None) -> str:
    """Raises `BadValue`."""
    if data is not None and len(data) > _LONGEST_ARGUMENT:
        raise BadValue(f"the argument has {len(data)} bytes, more than {_LONGEST_ARGUMENT}")
    try:
        return (data or b"").decode()
    except UnicodeDecodeError:
        raise BadValue("the argument is no UTF-8 text") from None


def _line_of(key: str, own: str) -> str | None:
    """The line that a key `<own>/lines/<line>/global` names."""
    match key.removeprefix(f"{own}/").split("/"):
        case ["lines", line, "global"]:
            return line
    return None


@dataclass(eq=False)
class Orders:
    """Passes orders on. Belongs to the event loop."""

    _keys: Keys
    _parts: Parts
    _audit: Audit  # gets each refusal
    _acceptance: Acceptance

    async def execute(self, part: str, key: str, data: bytes, sender: Sender) -> bytes | Failure:
        """Returns the new document. `key`, `data`: as received."""
        try:
            by = self._acceptance.accept(key, data, sender).by
            await self._acceptance.kept()
            if "*" in key:
                raise BadValue(f"{payload.short(key)} has a wildcard: an order names one")
            path = key.removeprefix(self._keys.status(f"{part}/"))
            return await self._parts.keyed(part).order(path, data, by)
        except GatewayError as error:
            failure = payload.audited(error)
            self._audit(WriteOutcome(key, None, failure, time.time_ns(), 0.0, command=True))
            return failure
