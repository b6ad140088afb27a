"""Writes the bytes of a line as a pcapng file, for Wireshark.

Wireshark needs no settings: a packet of a network device is one of TCP, any other names its
dissector (link type 252, "Wireshark upper PDU"). The addresses are made up: the master is 10.0.0.1,
the stations are 10.0.0.2.
"""

import os
from pathlib import Path
from struct import pack, unpack
from typing import Self

from gateway import files
from gateway.config import LineConfig
from gateway.errors import GatewayError, words_of
from gateway.protocols.listening import Asked, Listenable, TrafficReader

_RAW_IP, _UPPER_PDU = 101, 252  # link types
_SECTION, _INTERFACE, _PACKET = 0x0A0D0D0A, 1, 6
_DISSECTOR, _SOURCE, _DESTINATION, _PORT_TYPE, _SOURCE_PORT, _DESTINATION_PORT = (
    *(12, 20, 21),
    *(24, 25, 26),
)
_TCP, _TCP_IN_IP, _PUSH = 2, 6, 0x18
_End = tuple[bytes, int]  # address and port
_FLAGS = 2  # an option: 1 is received, 2 is sent
_MASTER: _End = bytes((10, 0, 0, 1)), 50000
_STATION: _End = bytes((10, 0, 0, 2)), 502
_PAUSE = 0.2  # seconds; bytes after it belong to another packet


class Capture:
    """A pcapng file of one line. Raises `GatewayError` when the disk is full or fails."""

    def __init__(self, path: Path, line: LineConfig) -> None:
        drivers = [device.driver for device in line.devices]
        named = [one.traits.dissector for one in drivers if one.traits.dissector]
        self._dissector = (named[0] if named else "data").encode()
        self._is_tcp = any(one.traits.over_network for one in drivers)
        self._sent = {_MASTER: 1, _STATION: 1}  # the sequence numbers of TCP
        readers = [
            one.traffic_reader(line.wire.character)
            for one in drivers
            if isinstance(one, Listenable)
        ]
        self._traffic_reader: TrafficReader | None = (
            readers[0] if readers else None
        )  # finds the ends of the frames
        self._path = path
        self._pending = b""  # received, and no whole frame yet
        self._begun = self._last = 0.0
        try:
            self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o640)
        except OSError as error:
            raise self._failed(error) from error
        self._write(_block(_SECTION, pack("<IHHq", 0x1A2B3C4D, 1, 0, -1)))
        link = _RAW_IP if self._is_tcp else _UPPER_PDU
        self._write(_block(_INTERFACE, pack("<HHI", link, 0, 0)))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._flush()
        finally:
            os.close(self._file)

    def add(self, at: float, way: str, data: bytes) -> None:
        """Adds bytes that were sent (`>`) or received (`<`) together; `at`: since 1970."""
        silence, self._last = at - self._last, at
        if way == ">" or silence > _PAUSE:
            self._flush()
        heard = [] if self._traffic_reader is None else self._traffic_reader.feed(data, silence)
        if way == ">":
            self._packet(at, data, asks=True, sent=True)
            return
        if not self._pending:
            self._begun = at
        self._pending += data
        if heard:
            self._flush(asks=isinstance(heard[-1], Asked))

    def _flush(self, *, asks: bool = False) -> None:
        if self._pending:
            self._packet(self._begun, self._pending, asks=asks, sent=False)
            self._pending = b""

    def _packet(self, at: float, data: bytes, *, asks: bool, sent: bool) -> None:
        source, destination = (_MASTER, _STATION) if asks else (_STATION, _MASTER)
        if self._is_tcp:
            pdu = _segment(source, destination, self._sent, data)
        else:
            pdu = _named(self._dissector, source, destination, data)
        high, low = divmod(round(at * 1e6), 2**32)
        flags = pack("<HHI", _FLAGS, 4, 2 if sent else 1) + pack("<HH", 0, 0)
        head = pack("<IIIII", 0, high, low, len(pdu), len(pdu))
        self._write(_block(_PACKET, head + _padded(pdu) + flags))

    def _write(self, data: bytes) -> None:
        try:
            files.append(self._file, data)
        except OSError as error:
            raise self._failed(error) from error

    def _failed(self, error: OSError) -> GatewayError:
        why = words_of(error)
        return GatewayError(f"capture ended: {self._path}: {why}; the gateway goes on")


def _segment(source: _End, destination: _End, sent: dict[_End, int], data: bytes) -> bytes:
    """Returns an IP packet with a TCP segment. Wireshark checks no sum of TCP by default."""
    ports, size = pack(">HH", source[1], destination[1]), len(data)
    tcp = ports + pack(">IIBBHHH", sent[source], sent[destination], 5 << 4, _PUSH, 65535, 0, 0)
    sent[source] = (sent[source] + size) % 2**32
    head = pack(">BBHHHBBH", 0x45, 0, 40 + size, 0, 0, 64, _TCP_IN_IP, 0)
    words = unpack(">10H", head + source[0] + destination[0])
    total = sum(words)
    total = (total & 0xFFFF) + (total >> 16)
    return head[:10] + pack(">H", ~total & 0xFFFF) + source[0] + destination[0] + tcp + data


def _named(dissector: bytes, source: _End, destination: _End, data: bytes) -> bytes:
    """Returns data with the name of its dissector, and with addresses."""
    return b"".join(
        (
            *(_tag(_DISSECTOR, dissector), _tag(_SOURCE, source[0])),
            *(_tag(_DESTINATION, destination[0]), _tag(_PORT_TYPE, pack(">I", _TCP))),
            _tag(_SOURCE_PORT, pack(">I", source[1])),
            _tag(_DESTINATION_PORT, pack(">I", destination[1])),
            *(pack(">HH", 0, 0), data),
        )
    )


def _block(kind: int, body: bytes) -> bytes:
    size = len(_padded(body)) + 12
    return pack("<II", kind, size) + _padded(body) + pack("<I", size)


def _tag(kind: int, value: bytes) -> bytes:
    value = _padded(value)
    return pack(">HH", kind, len(value)) + value


def _padded(data: bytes) -> bytes:
    return data + bytes(-len(data) % 4)
