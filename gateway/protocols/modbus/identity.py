"""The identity of a Modbus device: function 43/14, and 17 for the words of its maker."""

import re
from collections.abc import Collection, Mapping, Sequence
from typing import Any, Protocol

from gateway.errors import Refused
from gateway.protocols.driver import Talk
from gateway.protocols.modbus import pdu
from gateway.protocols.modbus.frame import READ_IDENTITY, REPORT_ID, Frame

# Application protocol V1.1b3, 6.21: the objects, and the level of the request that has them.
_OBJECTS = ("vendor", "product", "version", "url", "name", "model", "application")
_BASIC, _REGULAR, _EXTENDED = 1, 2, 3
_SERIAL = "serial"  # no object of the standard: any word of what the device tells
NAMES = frozenset((*_OBJECTS, _SERIAL))
_MOST_REPLIES = 16
_LONGEST = 253  # a PDU
_WORD = re.compile(r"[0-9A-Za-z](?:[0-9A-Za-z._/-]*[0-9A-Za-z])?")


class Asks(Protocol):
    """Sends a request; `accept` returns the contents of its reply, or None."""

    async def __call__(
        self, talk: Talk[Frame], request: bytes, longest: int, accept: Any
    ) -> Any: ...


async def identify(
    ask: Asks, talk: Talk[Frame], names: Collection[str]
) -> Mapping[str, Sequence[str]]:
    """Returns the texts of the device by name. Raises `Refused` if it cannot tell one of them."""
    level = _REGULAR if set(names) - {*_OBJECTS[:3], _SERIAL} else _BASIC
    if _SERIAL not in names:
        return _by_name(await _objects(ask, talk, level))
    objects, texts = dict[int, str](), list[str]()
    only = set(names) == {_SERIAL}  # many devices have function 17 alone, and are silent about 43
    if not only:
        objects = await _objects(ask, talk, _EXTENDED)
    try:
        data: bytes = await ask(talk, bytes((REPORT_ID,)), _LONGEST, _server_id)
        texts = [data.hex().upper(), data.decode("latin-1")]
    except Refused:
        if only:
            objects = await _objects(ask, talk, _EXTENDED)
    words = [word for text in (*objects.values(), *texts) for word in _WORD.findall(text)]
    return {**_by_name(objects), _SERIAL: words}


def _by_name(objects: Mapping[int, str]) -> dict[str, Sequence[str]]:
    return {_OBJECTS[at]: (text.strip(),) for at, text in objects.items() if at < len(_OBJECTS)}


async def _objects(ask: Asks, talk: Talk[Frame], level: int) -> dict[int, str]:
    found: dict[int, str] = {}
    first = 0
    head = bytes((READ_IDENTITY, 14, level))
    for _ in range(_MOST_REPLIES):
        reply: bytes = await ask(
            talk,
            bytes((*head, first)),
            _LONGEST,
            lambda heard: heard if heard.startswith(head) and pdu.objects_in(heard) else None,
        )
        found |= pdu.objects_in(reply) or {}
        more, following = reply[4], reply[5]
        if not more or following <= first:
            break
        first = following
    return found


def _server_id(heard: bytes) -> bytes | None:
    whole = len(heard) > 2 and heard[0] == REPORT_ID and len(heard) == 2 + heard[1]
    return heard[2:] if whole else None
