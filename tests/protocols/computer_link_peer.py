"""A Computer Link PLC for tests, byte by byte from the manual: it shares nothing with the gateway.

It hears one whole request and gives one whole answer. Devices are kept under their
five-character names; nothing is forgiven.
"""

from collections.abc import Iterable
from typing import Literal, TypeVar

T = TypeVar("T")

FrameFormat = Literal[1, 4]
Procedure = tuple[FrameFormat, bool]  # the second: sum check
PROCEDURES: list[Procedure] = [(1, True), (1, False), (4, True), (4, False)]


class _Missing(Exception):
    """A request names a device that this PLC does not have."""


def summed(block: bytes) -> bytes:
    total = 0
    for byte in block:
        total = (total + byte) % 256
    return f"{total:02X}".encode()


class Peer:
    """One PLC; `fx` for Mitsubishi's ranges and limits, else Liyan's."""

    def __init__(
        self, station: int, frame_format: int, sum_check: bool, *, fx: bool = False
    ) -> None:
        self.station, self.format, self.sum_check, self.fx = station, frame_format, sum_check, fx
        self.devices: dict[str, int] = {}
        self.registered: dict[str, list[str]] = {}
        self.confirmed = 0
        self.waits: list[int] = []
        self.missing: set[str] = set()  # NAK 06 for whatever reads or writes them

    # blocks

    def enq(self, text: str) -> bytes:
        body = text.encode()
        return b"\x05" + body + (summed(body) if self.sum_check else b"") + self.crlf

    def stx(self, data: str, pc: str = "FF") -> bytes:
        body = f"{self.station:02X}{pc}{data}".encode() + b"\x03"
        return b"\x02" + body + (summed(body) if self.sum_check else b"") + self.crlf

    def ack(self) -> bytes:
        return b"\x06" + f"{self.station:02X}FF".encode() + self.crlf

    def nak(self, code: str) -> bytes:
        return b"\x15" + f"{self.station:02X}FF{code}".encode() + self.crlf

    @property
    def crlf(self) -> bytes:
        return b"\x0d\x0a" if self.format == 4 else b""

    # conversation

    def hear(self, data: bytes) -> bytes:
        if data == self.ack():
            self.confirmed += 1
            return b""
        assert data[:1] == b"\x05", data
        assert data.endswith(self.crlf), data
        body = data[1 : len(data) - len(self.crlf)]
        if self.sum_check:
            body, check = body[:-2], body[-2:]
            assert summed(body) == check, data
        text = body.decode()
        if text[:4] != f"{self.station:02X}FF":
            return b""
        self.waits.append(int(text[6], 16))
        try:
            return self.obey(text[4:6], text[7:])
        except _Missing:
            return self.nak("06")

    def obey(self, command: str, area: str) -> bytes:
        match command:
            case "BR" | "WR" | "BW" | "WW":
                return self.batch(command, area)
            case "BT" | "WT":
                size = 6 if command == "BT" else 9
                entries = self.entries(area, size, 20 if command == "BT" else 10)
                self.has(entry[:5] for entry in entries)
                for entry in entries:
                    self.put([entry[:5]], entry[5:], command == "WT")
                return self.ack()
            case "BM" | "WM":
                assert not self.fx
                entries = self.entries(area, 5, 10)
                self.has(entries)
                self.registered[command[0]] = entries
                return self.ack()
            case "MB" | "MN" | "MW":
                assert area == ""
                kind = "B" if command == "MB" else "W"
                if kind not in self.registered:
                    return self.nak("06")
                self.has(self.registered[kind])
                return self.stx("".join(self.show(n, kind == "W") for n in self.registered[kind]))
            case "TT":
                assert 1 <= int(area[:2], 16) == len(area) - 2 <= (254 if self.fx else 128)
                return self.stx(area)
            case "PC":
                return self.stx("9D")
            case "RR" | "RS":
                assert area == ""
                return self.ack()
        raise AssertionError(command)

    def batch(self, command: str, area: str) -> bytes:
        names = self.run(area[:5], area[5:7], command)
        self.has(names)
        if command[1] == "W":
            return self.put(names, area[7:], command[0] == "W")
        assert len(area) == 7
        return self.stx("".join(self.show(name, command[0] == "W") for name in names))

    # devices

    def run(self, head: str, count: str, command: str) -> list[str]:
        """The names from `head` on, one for each item on the wire."""
        letters, number = self.split(head)
        items = int(count, 16)
        bit_device = letters in ("X", "Y", "M", "S")
        if command == "BR":
            most = 256 if self.fx else 64
            items = items or (256 if self.fx else 0)
        elif command == "BW":
            most = 160 if self.fx else 64
        elif letters == "CN" and number >= 200:
            most = 32 if self.fx else 16
        elif not bit_device:
            most = 64
        elif command == "WR":
            most = 32
        else:
            most = 10 if self.fx else 8
        assert 1 <= items <= most, (command, head, items)
        step = 16 if command[0] == "W" and bit_device else 1
        return [self.name(letters, number + i * step) for i in range(items)]

    def has(self, names: Iterable[str]) -> None:
        if not self.missing.isdisjoint(names):
            raise _Missing

    def entries(self, area: str, size: int, most: int) -> list[str]:
        count, rest = int(area[:2], 16), area[2:]
        assert 1 <= count <= most
        assert len(rest) == count * size
        found = [rest[i : i + size] for i in range(0, len(rest), size)]
        assert not any(entry[:3] == "CN2" for entry in found)
        return found

    def split(self, name: str) -> tuple[str, int]:
        letters = name[:2] if name[1].isalpha() else name[:1]
        assert len(name) == 5
        number = int(name[len(letters) :], 8 if letters in "XY" else 10)
        assert self.exists(letters, number), name
        return letters, number

    def name(self, letters: str, number: int) -> str:
        assert self.exists(letters, number), (letters, number)
        return letters + (f"{number:04o}" if letters in "XY" else f"{number:0{5 - len(letters)}d}")

    def exists(self, letters: str, number: int) -> bool:
        match letters:
            case "X" | "Y":
                return number <= (0o267 if self.fx else 0o177)
            case "M":
                return number <= (3071 if self.fx else 1535) or 8000 <= number <= 8255
            case "S":
                return number <= 999
            case "TS" | "CS" | "TN" | "CN":
                return number <= 255
            case "D":
                return number <= (7999 if self.fx else 3999) or 8000 <= number <= 8255
        return False

    def points(self, name: str) -> list[str] | None:
        """The sixteen points of a word over bit devices; None for a word device."""
        letters, number = self.split(name)
        assert letters not in ("TS", "CS")
        if letters not in ("X", "Y", "M", "S"):
            return None
        assert number % 8 == 0, name
        return [self.name(letters, number + i) for i in range(16)]

    def show(self, name: str, in_words: bool) -> str:
        if not in_words:
            assert name[:2] not in ("TN", "CN")
            assert name[0] != "D"
            return str(self.devices.get(name, 0))
        points = self.points(name)
        if points is not None:
            return f"{sum(self.devices.get(point, 0) << i for i, point in enumerate(points)):04X}"
        return f"{self.devices.get(name, 0):0{8 if name[:3] == 'CN2' else 4}X}"

    def put(self, names: list[str], data: str, in_words: bool) -> bytes:
        for name in names:
            if not in_words:
                assert data[0] in "01"
                self.devices[name], data = int(data[0]), data[1:]
                continue
            digits = 8 if name[:3] == "CN2" else 4
            value, data = int(data[:digits], 16), data[digits:]
            for i, point in enumerate(self.points(name) or []):
                self.devices[point] = value >> i & 1
            if self.points(name) is None:
                self.devices[name] = value
        assert data == ""
        return self.ack()
