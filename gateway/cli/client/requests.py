"""Writes, commands and orders of the command line, signed with the secret of its user."""

import json
import os
import time
from collections.abc import Callable, Mapping
from contextlib import suppress

import orjson
import zenoh

from gateway.cli.client.rows import document
from gateway.cli.client.value_pages import CHANGED, REPLY_TIMEOUT
from gateway.config.commands import TO_ALL
from gateway.contract.access.signatures import sign
from gateway.contract.keys import Keys
from gateway.errors import ConfigError, GatewayError
from gateway.tags import Tag
from gateway.tags.timestamps import rfc3339
from gateway.values import Value

WRITER_VARIABLE = "PLC_GATEWAY_WRITER"
OLD_VARIABLE = "PLC_GATEWAY_WRITE_TOKEN"  # of a version that sent its token
LONGEST_ORDER = 250_000  # bytes: a gateway's link drops larger messages


class Requests:
    """The requests of one `Client`."""

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        tags: Mapping[str, Tag],
        dialling: Mapping[str, float],
        query: Callable[[str], list[zenoh.Reply]],
        user: str | None,
    ) -> None:
        """`dialling`: seconds that a request may wait for a telephone call, by device."""
        self._session = session
        self._keys = keys
        self._tags = tags
        self._dialling = dialling
        self._query = query
        self._user = user

    def order(self, path: str, order: Mapping[str, object], more: float = 0.0) -> dict[str, object]:
        """Returns the document of `alarms/<alarm>` or `doors/<door>` then, or `error ...`. `more`:
        seconds that the answer may take longer than others. Raises as `write`."""
        status = self._keys.status("status")
        data = json.dumps(order, ensure_ascii=False).encode()
        if len(data) > LONGEST_ORDER:
            size = f"{len(data) / 1000:.0f} kB, more than {LONGEST_ORDER / 1000:.0f}"
            raise GatewayError(f"{path}: it has {size}: nothing was sent")
        return self._request(self._keys.status(path), data, status, more)

    def write(self, tag: str, value: Value | dict[str, Value]) -> dict[str, object]:
        """Returns the outcome as the gateway sends it: `value ...` or `error ...`.

        `tag`: also a device, with the values by tag. The outcome of each is in `tags`.

        Raises `GatewayError` when no gateway accepts the write, or none replies.
        """
        # Not orjson: it refuses integers beyond 64 bits, which a float tag accepts.
        device = tag.partition("/")[0]
        data, dialling = json.dumps(value).encode(), self._dialling.get(device, 0.0)
        return self._request(self._keys.set(tag), data, self._documents_of(device), dialling)

    def control(self, line: str, device: str, command: str, argument: str) -> dict[str, object]:
        """Returns the outcome of a command: `answer ...` or `error ...`. Raises as `write`."""
        if command == TO_ALL:
            status = self._keys.status("status")
            return self._request(self._keys.to_all(line), argument.encode(), status)
        key = self._keys.command(device, command)
        dialling = self._dialling.get(device, 0.0)
        return self._request(key, argument.encode(), self._documents_of(device), dialling)

    def peek(self, device: str, text: str) -> dict[str, object]:
        """Returns `address`, `units` and `time`, or `error ...`. Raises as `write`."""
        key, dialling = self._keys.command(device, "peek"), self._dialling.get(device, 0.0)
        return self._request(key, text.encode(), self._documents_of(device), dialling)

    def _documents_of(self, device: str) -> str:
        """One description of a device, or its state where it has no tag: only its gateway
        replies."""
        if not any(tag.device == device for tag in self._tags.values()):
            return self._keys.status(f"devices/{device}")
        return self._keys.meta(f"{device}/**") + "?page=1"

    def _request(
        self, key: str, payload: bytes, documents: str, dialling: float = 0.0
    ) -> dict[str, object]:
        """Sends a write or a command if a gateway accepts it. Returns the decoded reply.

        A query for `documents` comes first: only the gateway of the receiver replies to it. Every
        gateway under the prefix gets the request, and is silent when the receiver is not its own.
        A gateway that hangs does not get a request that it would execute later, after the client
        has given up. And Zenoh keeps messages in order, so after the reply the session knows
        whether a gateway may get the request.
        """
        timeout = REPLY_TIMEOUT + dialling
        # The reply has the priority of the query: before values and long answers.
        urgent = zenoh.Priority.INTERACTIVE_HIGH
        with self._session.declare_querier(key, timeout=timeout, priority=urgent) as querier:
            served = any(reply.ok is not None for reply in self._query(documents))
            matches = querier.matching_status
            if not (served and matches.matching):  # type: ignore[attr-defined]  # not in the stub
                may = f"may {self._user} do this, and " if self._user else ""
                raise GatewayError(f"no gateway accepts {key}: nothing was sent; {may}{CHANGED}")
            for reply in querier.get(payload=payload, attachment=signature(key, payload)):
                answer = reply.ok or reply.err
                with suppress(orjson.JSONDecodeError):  # Zenoh's own `Timeout` is not JSON
                    if answer is not None:
                        return document(answer.payload.to_bytes())
        raise GatewayError(f"{key}: no reply: it is unknown whether it was done")


def signature(key: str, payload: bytes) -> bytes | None:
    """Signs with the secret of the environment variable, if it is set. Raises `ConfigError`."""
    writer = os.environ.get(WRITER_VARIABLE)
    if not writer:
        if os.environ.get(OLD_VARIABLE):
            raise ConfigError(
                f"{OLD_VARIABLE}: tokens are no longer sent; set {WRITER_VARIABLE} to name:secret, "
                "as in the writers file"
            )
        return None
    name, _, secret = writer.partition(":")
    if not name or not secret:
        raise ConfigError(f"{WRITER_VARIABLE} is not name:secret, as in the writers file")
    return sign(name, secret, rfc3339(time.time_ns()), key, payload)
