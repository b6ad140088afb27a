"""Computer Link requests to a station (Liyan manual, chapter 2), over simulated or served data.

Errors (NAK), the lowest that applies: 02 for a wrong sum, 03 for an unknown command, 06 for
characters, lengths and devices, 07 for wrong data, 10 for another PC number, 18 for run and stop.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import NamedTuple

from gateway.protocols.checksums import byte_sum
from gateway.protocols.computer_link.codec import ALL_STATIONS, PC, Ack, Frame, Nak, Text
from gateway.stations.computer_link.devices import Cells, Kind, Profile, limits, locate
from gateway.stations.store import Cell, Denied, Rejected, Store, Why, Written

_BATCH = ("BR", "WR", "BW", "WW")
_ENTRY = {"BT": 6, "WT": 9, "BM": 5, "WM": 5}  # characters of a device, with data where written
_BARE = ("MB", "MN", "MW", "RR", "RS", "PC")  # the Liyan manual's code for MN spells MW
_GLOBAL, _LOOPBACK = "GW", "TT"
_COMMANDS = (*_BATCH, *_ENTRY, *_BARE, _GLOBAL, _LOOPBACK)
_WRITES = ("BW", "WW", "BT", "WT", "RR", "RS")
_HEX = frozenset("0123456789ABCDEF")
_STEP = 0.01  # seconds of the message wait
_RUNS = [1, 1]  # M8035, M8036


def addressed(text: str) -> int | None:
    """Returns the station of a request, `ALL_STATIONS` too; None for a damaged number."""
    return int(text[:2], 16) if len(text) > 1 and _HEX.issuperset(text[:2]) else None


class Request(NamedTuple):
    """A sound request without its sum."""

    station: int
    pc: str
    command: str
    wait: float  # seconds before the reply
    area: str


class Answer(NamedTuple):
    """The reply, if there is one, and the effect of the request."""

    reply: Frame | None
    wait: float = 0.0
    refused: str = ""
    write: bool = False
    written: Written = ()


def parse(text: str, *, sum_check: bool) -> Request:
    """Raises `Rejected` 02, 03, 06."""
    if sum_check:
        if byte_sum(text[:-2].encode("latin-1")).decode() != text[-2:]:
            raise Rejected("02")
        text = text[:-2]
    command, wait = text[4:6], text[6:7]
    if command not in _COMMANDS:
        raise Rejected("03")
    if not wait or wait not in _HEX:
        raise Rejected("06")
    return Request(int(text[:2], 16), text[2:4], command, int(wait, 16) * _STEP, text[7:])


class LinkStation:
    """One station. `switch_at_run`: its RUN/STOP switch; remote RUN works at STOP only."""

    def __init__(self, station: int, store: Store, profile: Profile, model: str = "") -> None:
        """`model`: the reply to PC; empty: it is refused."""
        self.station = station
        self.switch_at_run = False
        self._store = store
        self._limits = limits(profile)
        self._model = model
        self._lists: dict[str, list[Cells]] = {}  # by the command that registers them

    @property
    def running(self) -> bool:
        return self.switch_at_run or self._ordered() is True

    def _ordered(self) -> bool | None:
        """Returns True when M8035 and M8036 order RUN; None: the master has not said it."""
        try:
            return self._store.read("M8", 8035, 2) == _RUNS
        except Denied:
            return None

    def forget_monitor(self) -> None:
        """Loses the lists of BM and WM, as at power-off."""
        self._lists.clear()

    def answer(self, text: str, *, sum_check: bool) -> Answer:
        """Carries out a request to this station, or to all: then there is no reply."""
        wait, code = 0.0, "06"
        try:
            request = parse(text, sum_check=sum_check)
            wait = request.wait
            if request.command == _GLOBAL:
                return Answer(None, wait, "", True, self._global(request.area))
            if text[:2] == f"{ALL_STATIONS:02X}":
                return Answer(None)
            reply, written = self._carry_out(request)
            return Answer(reply, wait, "", request.command in _WRITES, written)
        except Rejected as refusal:
            code = refusal.code
        except Denied:
            pass
        return Answer(Nak(self.station, code), wait, code)

    def flags(self, **flags: int) -> Written:
        """Sets special relays."""
        return self._store.write([(("M8", int(name[1:])), flag) for name, flag in flags.items()])

    def _global(self, area: str) -> Written:
        """Sets the global flag; there is no reply, not even to a wrong request."""
        with suppress(Denied):
            return self.flags(M8126=int(area)) if area in ("0", "1") else ()
        return ()

    def _carry_out(self, request: Request) -> tuple[Frame, Written]:
        """Raises `Rejected` in the order of the codes, and `Denied`."""
        command, area = request.command, request.area
        if command in _BARE and area:
            raise Rejected("06")
        parts: list[tuple[Cells, Sequence[int]]] = []
        if command in _BATCH:
            parts = [self._batch(command, area)]
        elif command in _ENTRY:
            parts = list(self._listed(command, area))
        data = self._data(command, area, [cells for cells, _ in parts])
        if request.pc != PC:
            raise Rejected("10")
        if data is not None:
            return Text(self.station, data), ()
        if command in ("BM", "WM"):
            self._lists[command] = self._known([cells for cells, _ in parts])
            return Ack(self.station), ()
        if command in ("RR", "RS"):
            return Ack(self.station), self._remote(run=command == "RR")
        return Ack(self.station), self._write(parts)

    def _data(self, command: str, area: str, parts: list[Cells]) -> str | None:
        """Returns the data of the reply; None: it has none."""
        match command:
            case "BR" | "WR":
                return self._read(parts)
            case "TT":
                count = _hex(area[:2])
                if not 1 <= count <= self._limits.loopback or len(area) != 2 + count:
                    raise Rejected("06")
                if not (area.isascii() and area.isprintable()):
                    raise Rejected("07")
                return area
            case "PC" if self._model:
                return self._model
            case "MB" | "MN" | "MW" | "PC":
                listed = self._lists.get("BM" if command == "MB" else "WM")
                if command == "PC" or not listed:
                    raise Rejected("06")
                return self._read(listed)
        return None

    def _batch(self, command: str, area: str) -> tuple[Cells, Sequence[int]]:
        """Returns the devices of a BR, WR, BW or WW, with the units to write."""
        words, writes = command[0] == "W", command[1] == "W"
        count = _hex(area[5:7])
        if count == 0 and command == "BR" and self._limits.read[Kind.BITS] == 256:
            count = 256
        cells = locate(area[:5], words, count)
        most = self._limits.write if writes else self._limits.read
        if not 1 <= count <= most[cells.kind]:
            raise Rejected("06")
        if len(area) != 7 + (cells.characters if writes else 0):
            raise Rejected("06")
        return cells, cells.decode(area[7:]) if writes else ()

    def _listed(self, command: str, area: str) -> Iterator[tuple[Cells, Sequence[int]]]:
        """Yields the devices of a BT, WT, BM or WM, with the units to write."""
        count, size, limit = _hex(area[:2]), _ENTRY[command], self._limits
        most = {"BT": limit.scattered_bits, "WT": limit.scattered_words}.get(
            command, limit.monitored
        )
        if not 1 <= count <= most or len(area) != 2 + count * size:
            raise Rejected("06")
        entries = [area[at : at + size] for at in range(2, len(area), size)]
        places = [locate(entry[:5], command[0] == "W", 1) for entry in entries]
        if any(cells.kind is Kind.DWORDS for cells in places):
            raise Rejected("06")
        for cells, entry in zip(places, entries, strict=True):
            yield cells, cells.decode(entry[5:])

    def _read(self, parts: Sequence[Cells]) -> str:
        return "".join(cells.encode(self._units(cells)) for cells in parts)

    def _known(self, parts: list[Cells]) -> list[Cells]:
        """Returns the devices, if there are all of them; their values may be bad."""
        try:
            self._read(parts)
        except Denied as denied:
            if denied.why is not Why.BAD:
                raise
        return parts

    def _units(self, cells: Cells) -> list[int]:
        area, end = cells.area, cells.first + cells.size
        if cells.kind is not Kind.SIXTEENS:
            return self._store.read(area, cells.first, cells.size)
        firsts = range(cells.first, end, 16)
        return [unit for first in firsts for unit in self._store.read_points(area, first, 16)]

    def _write(self, parts: Sequence[tuple[Cells, Sequence[int]]]) -> Written:
        """Writes all parts as one."""
        points: list[tuple[Cell, int]] = []
        others: list[tuple[Cell, int]] = []
        for cells, units in parts:
            pairs = zip(cells, units, strict=True)
            (points if cells.kind is Kind.SIXTEENS else others).extend(pairs)
        return self._store.write(others, points)

    def _remote(self, *, run: bool) -> Written:
        """Starts or stops the program: M8035 to M8037."""
        if self.running if run else self._ordered() is False:
            raise Rejected("18")
        try:
            written = self.flags(M8035=int(run), M8036=int(run), M8037=int(not run))
        except Denied:
            raise Rejected("18") from None
        return written if self.running else (*written, *self._global("0"))


def _hex(text: str) -> int:
    if len(text) != 2 or not _HEX.issuperset(text):
        raise Rejected("06")
    return int(text, 16)
