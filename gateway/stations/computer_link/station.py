"""A simulated Liyan EX or Mitsubishi FX PLC: replies to Computer Link requests from its memory.

It finds its devices independent of the driver: tables of the Liyan manual 1-5 and chapter 2.
"""

from collections.abc import Callable, Iterable

from gateway.protocols.checksums import byte_sum
from gateway.protocols.computer_link.codec import (
    Ack,
    Frame,
    FrameFormat,
    LinkCodec,
    Nak,
    Text,
)
from gateway.stations.computer_link.devices import Cells, Kind, No, Profile, areas, limits, locate
from gateway.stations.computer_link.requests import RequestReader
from gateway.stations.station import Memory

_TIME_OUT = 0.1  # seconds, when D8129 is 0
_DEDICATED, _SUM, _FORMAT_4 = 0x4000, 0x2000, 0x8000  # D8120 b14, b13, b15
_9600_7E1 = 0x0086
_BAD_STATION, _INCOMPLETE = 6305, 6306
_ENTRY = {"BT": 6, "WT": 9, "BM": 5, "WM": 5}  # characters of a device, with data where written
_BATCH = ("BR", "WR", "BW", "WW")
_BARE = ("MB", "MN", "MW", "RR", "RS", "PC")  # the Liyan manual's code for MN spells MW
_COMMANDS = (*_BATCH, *_ENTRY, *_BARE, "GW", "TT")
_HEX = frozenset("0123456789ABCDEF")

Act = Callable[[float], Frame]


class ComputerLinkStation:
    """A PLC of one station number, by default with every device of its profile, in remote RUN.

    Memory areas are the driver's: X Y M S TS CS bits (octal numbers as plain integers), T C D
    words, C32 the counters from C200 on (32 bits), M8 and D8 the special devices from 8000 on.
    `power_cycle` applies D8120 and D8121; D8129 applies at once.
    """

    def __init__(
        self,
        station: int,
        profile: Profile = "liyan",
        frame_format: FrameFormat = 1,
        sum_check: bool = True,
        *,
        holes: Iterable[tuple[str, int]] = (),
        model: str = "9E",
    ) -> None:
        """`holes`: devices (area, number) that this model lacks; `model`: the reply to PC."""
        self.station = station
        self.frame_format: FrameFormat = frame_format
        self.sum_check = sum_check
        self.holes = set(holes)
        self.model = model
        self.mute = False  # carries out requests, but its replies are lost
        self.switch_at_run = False  # the RUN/STOP switch; remote RUN works at STOP only
        self.delay = 0.0  # seconds of message wait in the last request
        self._speaks = True
        self._limits = limits(profile)
        self._memory = Memory(areas(profile))
        procedure = _DEDICATED | sum_check * _SUM | (frame_format == 4) * _FORMAT_4
        self._memory.write("D8", 8120, [procedure | _9600_7E1, station])
        self._flags(M8035=1, M8036=1)
        self._bits: list[Cells] = []
        self._words: list[Cells] = []
        self._reader = RequestReader(frame_format, sum_check)

    @property
    def memory(self) -> Memory:
        return self._memory

    @property
    def running(self) -> bool:
        return self.switch_at_run or self._memory.read("M8", 8035, 2) == [1, 1]

    def forget_monitor(self) -> None:
        """Loses the lists of BM and WM, as at power-off."""
        self._bits, self._words = [], []

    def power_cycle(self) -> None:
        """Switches off and on: applies D8120 and D8121, loses flags and registered lists."""
        procedure, station = self._memory.read("D8", 8120, 2)
        self.frame_format = 4 if procedure & _FORMAT_4 else 1
        self.sum_check = bool(procedure & _SUM)
        self._speaks = bool(procedure & _DEDICATED)
        self.station = station
        self._flags(M8035=0, M8036=0, M8037=0, M8063=0, M8126=0)
        self._reader = RequestReader(self.frame_format, self.sum_check)
        self.forget_monitor()

    def on_demand(self, data: str) -> bytes:
        """Returns an unsolicited block of the PLC, with PC number FE."""
        return self._encode(Text(self.station, data, "FE"))

    def hear(self, data: bytes, now: float) -> list[bytes]:
        """Returns the replies to the requests that `data` completes; the last waits for `delay`."""
        self._expire(now)
        answers = [self._answer(text, now) for text in self._reader.feed(data, now)]
        return (
            []
            if self.mute or not self._speaks
            else [self._encode(frame) for frame in answers if frame is not None]
        )

    def _expire(self, now: float) -> None:
        """Discards a message that did not end within D8129, without a reply."""
        time_out = self._memory.read("D8", 8129)[0] / 100 or _TIME_OUT
        if self._reader.expire(now, time_out)[:2] == f"{self.station:02X}":
            self._fault(_INCOMPLETE)

    def _fault(self, code: int) -> None:
        self._flags(M8063=1)
        self._memory.write("D8", 8063, [code])

    def _flags(self, **flags: int) -> None:
        for name, value in flags.items():
            self._memory.write("M8", int(name[1:]), [value])

    # Replies

    def _answer(self, text: str, now: float) -> Frame | None:
        if text[:2] == "FF":
            self._all_stations(text)
            return None
        if text[:2] != f"{self.station:02X}":
            return None
        try:
            return self._carry_out(text, now)
        except No as refusal:
            return Nak(self.station, refusal.code)

    def _carry_out(self, text: str, now: float) -> Frame | None:
        """Carries out a request; checks in the order of the error codes: 02, 03, 06, 07, 10, 18."""
        self.delay = 0.0
        body = self._body(text)
        pc, command, wait, area = body[2:4], body[4:6], body[6:7], body[7:]
        if command not in _COMMANDS:
            raise No("03")
        if wait not in _HEX:
            raise No("06")
        self.delay = int(wait, 16) / 100
        if command == "GW":
            self._global(area)
            return None
        act = self._action(command, area)
        if pc != "FF":
            raise No("10")
        return act(now)

    def _body(self, text: str) -> str:
        """Returns the block without its sum."""
        if not self.sum_check:
            return text
        if byte_sum(text[:-2].encode("latin-1")).decode() != text[-2:]:
            raise No("02")
        return text[:-2]

    def _all_stations(self, text: str) -> None:
        """Accepts only the global flag for station FF, without a reply."""
        try:
            body = self._body(text)
        except No:
            return
        if body[4:6] == "GW":
            self._global(body[7:])
        else:
            self._fault(_BAD_STATION)

    def _global(self, area: str) -> None:
        """Sets the global flag; there is no reply, not even to a wrong request."""
        if area in ("0", "1"):
            self._flags(M8126=int(area))

    def _action(self, command: str, area: str) -> Act:
        match command:
            case "BR" | "WR" | "BW" | "WW":
                return self._batch(command, area)
            case "BT" | "WT" | "BM" | "WM":
                return self._list(command, area)
            case "TT":
                return self._loopback(area)
        if area:
            raise No("06")
        return self._bare(command)

    def _bare(self, command: str) -> Act:
        match command:
            case "PC":
                return lambda now: Text(self.station, self.model)
            case "RR":
                return lambda now: self._remote_run()
            case "RS":
                return lambda now: self._remote_stop()
        cells = self._bits if command == "MB" else self._words
        if not cells or any(cell in self.holes for part in cells for cell in part):
            raise No("06")
        return lambda now: self._text(cells, now)

    def _batch(self, command: str, area: str) -> Act:
        words, writes = command[0] == "W", command[1] == "W"
        count = _hex(area[5:7])
        if count == 0 and command == "BR" and self._limits.read[Kind.BITS] == 256:
            count = 256
        cells = self._locate(area[:5], words, count)
        most = self._limits.write if writes else self._limits.read
        if not 1 <= count <= most[cells.kind]:
            raise No("06")
        if len(area) != 7 + (cells.characters if writes else 0):
            raise No("06")
        if not writes:
            return lambda now: self._text([cells], now)
        units = cells.decode(area[7:])
        return lambda now: self._write([(cells, units)])

    def _list(self, command: str, area: str) -> Act:
        words, registers = command[0] == "W", command[1] == "M"
        count, size = _hex(area[:2]), _ENTRY[command]
        if not 1 <= count <= self._most_listed(command) or len(area) != 2 + count * size:
            raise No("06")
        entries = [area[i : i + size] for i in range(2, len(area), size)]
        cells = [self._locate(entry[:5], words, 1) for entry in entries]
        if any(part.kind is Kind.DWORDS for part in cells):
            raise No("06")
        if registers:
            return lambda now: self._register(cells, words)
        parts = [(part, part.decode(entry[5:])) for part, entry in zip(cells, entries, strict=True)]
        return lambda now: self._write(parts)

    def _most_listed(self, command: str) -> int:
        match command:
            case "BT":
                return self._limits.scattered_bits
            case "WT":
                return self._limits.scattered_words
        return self._limits.monitored

    def _loopback(self, area: str) -> Act:
        count = _hex(area[:2])
        if not 1 <= count <= self._limits.loopback or len(area) != 2 + count:
            raise No("06")
        if not (area.isascii() and area.isprintable()):
            raise No("07")
        return lambda now: Text(self.station, area)

    def _locate(self, device: str, words: bool, count: int) -> Cells:
        cells = locate(device, words, count)
        if not self._memory.holds(cells.area, cells.first, cells.size):
            raise No("06")
        if any(cell in self.holes for cell in cells):
            raise No("06")
        guard, numbers = self._memory.guard, range(cells.first, cells.first + cells.size)
        if guard is not None and guard(cells.area, numbers):
            raise No("06")
        return cells

    # Actions

    def _text(self, cells: list[Cells], now: float) -> Text:
        data = "".join(
            part.encode(self._memory.read(part.area, part.first, part.size, now)) for part in cells
        )
        return Text(self.station, data)

    def _write(self, parts: list[tuple[Cells, list[int]]]) -> Ack:
        for cells, units in parts:
            self._memory.write(cells.area, cells.first, units)
        return Ack(self.station)

    def _register(self, cells: list[Cells], words: bool) -> Ack:
        if words:
            self._words = cells
        else:
            self._bits = cells
        return Ack(self.station)

    def _remote_run(self) -> Ack:
        if self.running:
            raise No("18")
        self._flags(M8035=1, M8036=1, M8037=0)
        return Ack(self.station)

    def _remote_stop(self) -> Ack:
        if self._memory.read("M8", 8035, 2) != [1, 1]:
            raise No("18")
        self._flags(M8037=1, M8035=0, M8036=0)
        if not self.running:
            self._flags(M8126=0)
        return Ack(self.station)

    def _encode(self, frame: Frame) -> bytes:
        return LinkCodec(self.frame_format, self.sum_check).encode(frame)


def _hex(text: str) -> int:
    if len(text) != 2 or not _HEX.issuperset(text):
        raise No("06")
    return int(text, 16)
