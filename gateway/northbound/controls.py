"""Commands that come over Zenoh: checked, handed down, answered, and every outcome told.

<prefix>/<device>/@run, @stop, @loopback, @model        by device, in full
<prefix>/@gateway/<name>/lines/<line>/global            to all stations of a line: on, off
"""

import asyncio
import time
from collections.abc import Callable, Mapping
from typing import Protocol

import orjson
import zenoh

from gateway.config.commands import TO_ALL, NotControlled
from gateway.engine.requests import CommandResult
from gateway.errors import BadValue, GatewayError
from gateway.northbound import forms, payload
from gateway.northbound.keys import Keys
from gateway.northbound.payload import Failure, Problem, WriteOutcome
from gateway.northbound.writers import Asker, NotAllowed, Writers
from gateway.northbound.writes import ANSWER_WITHIN

_LONGEST_ARGUMENT = 1000  # bytes; a loopback takes 254 characters at most


class Commanded(Protocol):
    """The gateway below, as far as it tells devices what to do."""

    def commands(self) -> Mapping[str, frozenset[str]]:
        """By device: what its protocol knows, allowed or not."""

    def speaker(self, line: str) -> str:
        """The device in whose name all stations of a line are told. Raises `BadValue`."""

    async def control(self, device: str, command: str, argument: str) -> CommandResult:
        """Returns what the device said. Raises `GatewayError`; `BadValue` before anything."""


class Controls:
    """Bounded by the queries that may be open and by the orders that may wait for a line."""

    def __init__(
        self,
        keys: Keys,
        below: Commanded,
        stamp: Callable[[], zenoh.Timestamp],
        told: Callable[[WriteOutcome], None],
        writers: Writers | None = None,
    ) -> None:
        """`told` gets every outcome; `writers`: who may command are those who may write."""
        self._keys = keys
        self._below = below
        self._stamp = stamp
        self._told = told
        self._writers = writers

    @property
    def queryables(self) -> list[str]:
        """The keys to be declared; those of lines lie under the gateway's own."""
        return [
            self._keys.command(device, command)
            for device, commands in self._below.commands().items()
            for command in sorted(commands)
        ]

    async def obey(self, key: str, data: bytes | None, asker: Asker) -> CommandResult | Failure:
        """`key` as it came, wildcards and all; `data` is the argument as text."""
        by, argument = asker.session, ""
        started = time.monotonic()
        result: CommandResult | Failure = Failure(Problem.UNCLEAR, "the gateway is ending")
        try:
            if self._writers is not None:
                by = self._writers.owner(asker.token)
            argument = _argument(data)
            device, command = self._meant(key)
            async with asyncio.timeout(ANSWER_WITHIN):
                result = await self._below.control(device, command, argument)
        except TimeoutError:
            reason = f"not answered within {ANSWER_WITHIN:g} s: it may yet be done"
            result = Failure(Problem.UNCLEAR, reason)
        except NotAllowed as error:
            result = Failure(Problem.NOT_ALLOWED, str(error))
        except NotControlled as error:
            result = Failure(Problem.NOT_WRITABLE, str(error))
        except GatewayError as error:
            result = payload.failure(error)
        finally:
            took = time.monotonic() - started
            value = argument or None
            self._told(WriteOutcome(key, value, result, time.time_ns(), took, by, command=True))
        return result

    def reply(self, result: CommandResult | Failure, query: zenoh.Query) -> None:
        """On an answering thread."""
        match result:
            case CommandResult(answer, at, took):
                told = {"answer": answer, "time": payload.rfc3339(at), "took": round(took, 6)}
                forms.reply_json(query, str(query.key_expr), orjson.dumps(told), self._stamp())
            case Failure():
                data = payload.outcome(result)
                query.reply_err(data, encoding=zenoh.Encoding.APPLICATION_JSON)

    def _meant(self, key: str) -> tuple[str, str]:
        """Device and command. Raises `BadValue`."""
        if "*" in key:
            raise BadValue(f"{payload.short(key)} has a wildcard: a command names one, in full")
        for line in _line_of(key, self._keys.own):
            return self._below.speaker(line), TO_ALL
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


def _line_of(key: str, own: str) -> list[str]:
    """The line that a key `<own>/lines/<line>/global` names, or none."""
    chunks = key.removeprefix(f"{own}/").split("/")
    match chunks:
        case ["lines", line, "global"]:
            return [line]
    return []
