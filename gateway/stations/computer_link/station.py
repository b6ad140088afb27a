"""A simulated Liyan EX or Mitsubishi FX PLC: replies to Computer Link requests from its memory.

It finds its devices independent of the driver: tables of the Liyan manual 1-5 and chapter 2.
"""

from collections.abc import Iterable

from gateway.protocols.computer_link.codec import ALL_STATIONS, Frame, FrameFormat, LinkCodec, Text
from gateway.stations.computer_link.answers import LinkStation, addressed, parse
from gateway.stations.computer_link.devices import Profile, areas
from gateway.stations.computer_link.requests import RequestReader
from gateway.stations.station import Memory, MemoryStore
from gateway.stations.store import Rejected

_TIME_OUT = 0.1  # seconds, when D8129 is 0
_DEDICATED, _SUM, _FORMAT_4 = 0x4000, 0x2000, 0x8000  # D8120 b14, b13, b15
_9600_7E1 = 0x0086
_BAD_STATION, _INCOMPLETE = 6305, 6306


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
        self.frame_format: FrameFormat = frame_format
        self.sum_check = sum_check
        self.mute = False  # carries out requests, but its replies are lost
        self.delay = 0.0  # seconds of message wait in the last request
        self.memory = Memory(areas(profile), holes)
        self._speaks = True
        self._store = MemoryStore(self.memory)
        self.link = LinkStation(station, self._store, profile, model)
        procedure = _DEDICATED | sum_check * _SUM | (frame_format == 4) * _FORMAT_4
        self.memory.write("D8", 8120, [procedure | _9600_7E1, station])
        self.link.flags(M8035=1, M8036=1)
        self._reader = RequestReader(frame_format, sum_check)

    @property
    def station(self) -> int:
        return self.link.station

    def power_cycle(self) -> None:
        """Switches off and on: applies D8120 and D8121, loses flags and registered lists."""
        procedure, station = self.memory.read("D8", 8120, 2)
        self.frame_format = 4 if procedure & _FORMAT_4 else 1
        self.sum_check = bool(procedure & _SUM)
        self._speaks = bool(procedure & _DEDICATED)
        self.link.station = station
        self.link.flags(M8035=0, M8036=0, M8037=0, M8063=0, M8126=0)
        self._reader = RequestReader(self.frame_format, self.sum_check)
        self.link.forget_monitor()

    def on_demand(self, data: str) -> bytes:
        """Returns an unsolicited block of the PLC, with PC number FE."""
        return self._encode(Text(self.station, data, "FE"))

    def hear(self, data: bytes, now: float) -> list[bytes]:
        """Returns the replies to the requests that `data` completes; the last waits for `delay`."""
        self._expire(now)
        self._store.now = now
        replies = [self._answer(text) for text in self._reader.feed(data, now)]
        silent = self.mute or not self._speaks
        return [self._encode(frame) for frame in replies if frame is not None and not silent]

    def _answer(self, text: str) -> Frame | None:
        number = addressed(text)
        if number not in (self.station, ALL_STATIONS):
            return None
        if number == ALL_STATIONS and self._is_wrong(text):
            self._fault(_BAD_STATION)
        answer = self.link.answer(text, sum_check=self.sum_check)
        if number == ALL_STATIONS:
            return None
        self.delay = answer.wait
        return answer.reply

    def _is_wrong(self, text: str) -> bool:
        """Returns True for a sound request to all stations that is no GW."""
        try:
            return parse(text, sum_check=self.sum_check).command != "GW"
        except Rejected as refusal:
            return refusal.code != "02"

    def _expire(self, now: float) -> None:
        """Discards a message that did not end within D8129, without a reply."""
        time_out = self.memory.read("D8", 8129)[0] / 100 or _TIME_OUT
        if self._reader.expire(now, time_out)[:2] == f"{self.station:02X}":
            self._fault(_INCOMPLETE)

    def _fault(self, code: int) -> None:
        self.link.flags(M8063=1)
        self.memory.write("D8", 8063, [code])

    def _encode(self, frame: Frame) -> bytes:
        return LinkCodec(self.frame_format, self.sum_check).encode(frame)
