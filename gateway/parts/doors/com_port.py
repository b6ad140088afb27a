"""Reads a program at a raw door: bytes for the wire, and changes of the serial port."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple, Protocol

from gateway.transport.telnet import Agreed, Asked, Received, Send, Setting, Telnet

_SIGNATURE, _LINE_STATE_MASK, _MODEM_STATE_MASK = 0, 10, 11
_OBEYED = {
    Setting.BAUDRATE: 4,  # bytes of the value
    Setting.DATA_BITS: 1,
    Setting.PARITY: 1,
    Setting.STOP_BITS: 1,
    Setting.CONTROL: 1,
    Setting.PURGE: 1,
}
DRAINS = frozenset(_OBEYED) - {Setting.PURGE}  # they wait until all bytes have been sent


class Change(NamedTuple):
    """A setting of RFC 2217, and its value; 0 asks for the present one."""

    setting: Setting
    value: int


class Reply(NamedTuple):
    """Bytes for the program."""

    data: bytes


Item = bytes | Change | Reply


class Speech(Protocol):
    """One connection."""

    def begin(self) -> bytes:
        """Returns the first bytes to the program; later none."""

    def hear(self, data: bytes) -> Sequence[Item]:
        """Returns what the program wants, in its order."""

    def encode(self, data: bytes) -> bytes:
        """Returns bytes of the wire, as the program gets them."""

    def done(self, change: Change, value: int) -> bytes:
        """Returns the acknowledgement. `value`: what the port has now."""


class Plain:
    """Bytes as they are: a TCP connection or a terminal. A `Speech`."""

    def begin(self) -> bytes:
        return b""

    def hear(self, data: bytes) -> Sequence[Item]:
        return [data]

    def encode(self, data: bytes) -> bytes:
        return data

    def done(self, _change: Change, _value: int) -> bytes:
        return b""


class ComPort:
    """The server's end of RFC 2217. A `Speech`."""

    def __init__(self) -> None:
        self._telnet = Telnet(serves=True)
        self._begun = False

    def begin(self) -> bytes:
        begun, self._begun = self._begun, True
        return b"" if begun else self._telnet.start()

    def hear(self, data: bytes) -> Sequence[Item]:
        return [item for event in self._telnet.feed(data) for item in self._items(event)]

    def _items(self, event: object) -> Iterator[Item]:
        match event:
            case Received(data):
                yield data
            case Send(data):
                yield Reply(data)
            case Asked(number, data) if number in _OBEYED and data:
                yield Change(Setting(number), int.from_bytes(data[:4], "big"))
            case Asked(number, data) if number in (_LINE_STATE_MASK, _MODEM_STATE_MASK):
                yield Reply(Telnet.answer(number, data[:1]))
            case Asked(number, b"") if number == _SIGNATURE:
                yield Reply(Telnet.answer(number, b"plc-gateway"))
            case Agreed() | _:
                return

    def encode(self, data: bytes) -> bytes:
        return Telnet.encode(data)

    def done(self, change: Change, value: int) -> bytes:
        size = _OBEYED.get(change.setting, 1)
        return Telnet.answer(change.setting, value.to_bytes(size, "big"))
