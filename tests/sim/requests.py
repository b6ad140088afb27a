"""Parses the requests of the gateway a second time: station, kind, address."""

from typing import NamedTuple

ALL = {"modbus-rtu": 0, "modbus-ascii": 0, "computer-link": 255}  # the broadcast numbers
_AREAS = {1: "coil", 2: "discrete", 3: "holding", 4: "input"}
_LETTERS = b"abcdefghijklmnopqrstuvwxyz"


class Asked(NamedTuple):
    """A Modbus TCP request, or another frame with its number."""

    unit: int
    number: int
    area: str
    start: int
    size: int

    def covers(self, area: str, start: int, size: int) -> bool:
        return self.area == area and (
            self.start <= start and start + size <= self.start + self.size
        )


def protocol_of(usual: str, data: bytes) -> str:
    """Returns the protocol of a frame on a line whose devices mostly use `usual`."""
    if usual == "modbus-tcp":
        return usual
    if usual == "frames":
        return usual if data[:1] == b"\x01" or data[0] in _LETTERS else "vigor"
    if usual == "vigor" and data[:1] == b"\x05" and data[3:5] == b"FF":
        return "computer-link"
    return usual


def station_in(protocol: str, data: bytes) -> int:
    """Returns the station number, or the letter of a device without a protocol."""
    match protocol:
        case "modbus-rtu":
            return data[0]
        case "modbus-tcp":
            return data[6]
        case "frames":
            return data.lstrip(b"\x01")[0]
    return int(data[1:3], 16)


def is_write(protocol: str, data: bytes) -> bool:
    match protocol:
        case "vigor":
            return data[3:5] in (b"61", b"70", b"71")
        case "computer-link":
            return data[5:7] in (b"BW", b"WW", b"BT", b"WT")
        case "modbus-rtu":
            return data[1] in (5, 6, 15, 16)
        case "modbus-tcp":
            return data[7] in (5, 6, 15, 16)
        case "frames":
            return data.lstrip(b"\x01")[1:3] in (b"S=", b"T=")
    return data[3:5] in (b"05", b"06", b"0F", b"10")


def shape_of(protocol: str, data: bytes) -> tuple[object, ...] | None:
    """Returns what a reply to a read tells: the station, the function or text, the length.

    None for a request whose reply is not that of a plain read.
    """
    match protocol:
        case "modbus-rtu" if 1 <= data[1] <= 4:
            return data[0], data[1], _bytes(data[1], int.from_bytes(data[4:6], "big"))
        case "modbus-ascii" if b"01" <= data[3:5] <= b"04":
            function = int(data[3:5])
            return int(data[1:3], 16), function, _bytes(function, int(data[9:13], 16))
        case "vigor" if data[3:5] == b"51":
            return data[1:3], int(data[9:11], 16)
        case "computer-link" if data[5:7] in (b"BR", b"WR"):
            digits = 8 if b"CN200" <= data[8:13] <= b"CN255" else 4
            return data[1:3], int(data[13:15], 16) * (1 if data[5:7] == b"BR" else digits)
        case "frames" if data.lstrip(b"\x01")[1:2] == b"Q":
            return (data,)
    return None


def _bytes(function: int, count: int) -> int:
    return (count + 7) // 8 if function in (1, 2) else 2 * count


def is_command(protocol: str, data: bytes) -> bool:
    return protocol == "computer-link" and data[5:7] in (b"RR", b"RS", b"GW")


def is_registration(protocol: str, data: bytes) -> bool:
    """The frame registers a monitor list."""
    return protocol == "computer-link" and data[5:7] in (b"BM", b"WM")


def answer_in(data: bytes) -> int | None:
    """Returns the number that the reply to an unsolicited frame repeats."""
    body = data.lstrip(b"\x01")
    return int(body[2:7]) if body[1:2] == b"!" else None


def asked(data: bytes) -> Asked:
    """Parses a Modbus TCP frame."""
    number = int.from_bytes(data[:2], "big")
    area = _AREAS.get(data[7], "")
    start, size = int.from_bytes(data[8:10], "big"), int.from_bytes(data[10:12], "big")
    return Asked(data[6], number, area, start, size)
