"""Liyan EX and Mitsubishi FX over the Computer Link, also called dedicated protocol or FX links.

Liyan Computer Link manual (Lylink-edoc0307), section numbers below are its own.
"""

import re
from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal, TypeVar

from gateway.errors import BadValue, ConfigError
from gateway.protocols.capabilities import ScanHints
from gateway.protocols.computer_link.access import (
    Access,
    data_characters,
    decode_all,
    listed_characters,
    monitored_access,
    possible,
    read_access,
    scattered_access,
    write_access,
)
from gateway.protocols.computer_link.codec import (
    ALL_STATIONS,
    PC_ON_DEMAND,
    Ack,
    Enquiry,
    Frame,
    FrameFormat,
    LinkCodec,
    Text,
)
from gateway.protocols.computer_link.devices import DEVICE, PROFILES, Profile, ProfileName
from gateway.protocols.computer_link.replies import (
    AREA_C_ECHO,
    NO_REPLY_CAUSES,
    accept_ack,
    accept_text,
    describe_stray,
    model_name,
)
from gateway.protocols.computer_link.traffic import Read, learn, link_traffic_reader
from gateway.protocols.devices import parse_device, spell_device
from gateway.protocols.driver import (
    EVERY_REQUEST,
    PROOF,
    Address,
    Area,
    Cost,
    Span,
    Talk,
    Timing,
    Traits,
)
from gateway.protocols.harmless import HarmlessReads, resync_by_reads
from gateway.protocols.listening import Learn, TrafficReader
from gateway.protocols.resync_kind import ResyncKind

LinkTalk = Talk[Frame]
T = TypeVar("T")

_COUNT, _CODE = 2, 2  # characters of a count, of an error code
_ACK = "ack"
_WIDER = 4  # addresses around the only one, for reads of another length
_SWITCH = {"1": "1", "on": "1", "true": "1", "0": "0", "off": "0", "false": "0"}


@dataclass(frozen=True, slots=True, kw_only=True)
class ComputerLink:
    """A PLC on the Computer Link; the fields are its settings in the file.

    `message_wait` is seconds in steps of 10 ms: the PLC replies no sooner. `send_area_c`
    acknowledges each data reply. `monitor` registers scattered addresses in the PLC.
    """

    protocol: Literal["computer-link"] = "computer-link"
    station: int = 0
    profile: ProfileName = "liyan"
    frame_format: FrameFormat = 1
    sum_check: bool = True
    message_wait: float = 0.0
    send_area_c: bool = False
    monitor: bool = False
    monitor_word_command: Literal["MN", "MW"] = "MN"
    _kind: ResyncKind = field(init=False, repr=False, compare=False)

    scan_hints: ClassVar = ScanHints(
        formats=("7E1", "8N1", "8E1", "7O1"),
        stations=range(32),
        variants=tuple(
            {"frame_format": form, "sum_check": checked}
            for form in (1, 4)
            for checked in (True, False)
        ),
    )
    traits: ClassVar = Traits(baudrate=9600, format="7E1", no_reply_causes=NO_REPLY_CAUSES)
    unnumbered: ClassVar = True
    controls: ClassVar = frozenset({"run", "stop", "loopback", "model", "global"})
    broadcast_commands: ClassVar = frozenset({"global"})

    def __post_init__(self) -> None:
        object.__setattr__(self, "_kind", ResyncKind())
        if self.profile not in PROFILES:
            raise ConfigError(f"profile {self.profile!r} is not one of {', '.join(PROFILES)}")
        if not 0 <= self.station <= self._limits.last_station:
            raise ConfigError(
                f"station {self.station} is not 0..{self._limits.last_station} "
                f"(profile {self.profile})"
            )
        if self.frame_format not in (1, 4):
            raise ConfigError(f"frame_format {self.frame_format} is not 1 or 4")
        steps = self.message_wait * 100
        if not 0 <= steps <= 15.0001 or abs(steps - round(steps)) > 0.0001:
            raise ConfigError("message_wait is 0ms to 150ms in steps of 10ms")
        if self.monitor and not self._limits.monitored:
            raise ConfigError(f"monitor: a PLC of profile {self.profile} has no monitor commands")
        if self.monitor_word_command not in ("MN", "MW"):
            raise ConfigError(f"monitor_word_command {self.monitor_word_command!r} is not MN or MW")

    @property
    def reply_starts(self) -> Sequence[bytes]:
        return (b"\x02%02XFF" % self.station,)

    @property
    def areas(self) -> Mapping[str, Area]:
        return self._limits.areas

    @property
    def echo_conflict(self) -> tuple[str, str] | None:
        return ("send_area_c", AREA_C_ECHO) if self.send_area_c else None

    @property
    def timing(self) -> Timing:
        return Timing(
            reply_timeout=1.0 + self.message_wait,
            turnaround=max(0.02, self.message_wait),
            silence=0.02,  # about two scans of the PLC before the next ENQ
            retries=2,
            learn_silence=self.sum_check,  # without it, a damaged request may read another address
        )

    def address(self, text: str) -> Address:
        """Parses `D100`, `D0100`, `X17` (octal), `TN5` or `T5`, `D7.3`. Raises `ConfigError`."""
        letters = text[:2].upper()
        if letters in ("TC", "CC") and text[2:3].isdigit():
            contact, value = f"{letters[0]}S{text[2:]}", f"{letters[0]}{text[2:]}"
            raise ConfigError(
                f"{text}: timer and counter coils cannot be reached over the Computer Link; "
                f"the contact is {contact}, the current value {value}"
            )
        return parse_device(text, self._limits.table)

    def spell(self, address: Address) -> str:
        return spell_device(address, self._limits.table)

    def codec(self) -> LinkCodec:
        return LinkCodec(self.frame_format, self.sum_check)

    # Batch read and write (2-1 to 2-4)

    def cost(self, span: Span) -> Cost | None:
        access = read_access(self._limits, span)
        return None if access is None else self._text_cost(DEVICE + _COUNT, access.characters)

    def write_cost(self, span: Span) -> Cost | None:
        access = write_access(self._limits, span)
        return None if access is None else self._ack_cost(DEVICE + _COUNT + access.characters)

    async def read(self, talk: LinkTalk, span: Span) -> Sequence[int]:
        access = possible(read_access(self._limits, span), span)
        command = "WR" if access.in_words else "BR"
        return await self._ask_text(talk, command, access.batch, access.characters, access.decode)

    async def write(self, talk: LinkTalk, span: Span, units: Sequence[int]) -> bool:
        access = possible(write_access(self._limits, span), span)
        command = "WW" if access.in_words else "BW"
        return await self._ask_ack(talk, command, access.batch + "".join(access.encode(units)))

    # Scattered writes (2-5, 2-6)

    def scattered_write_cost(self, spans: Sequence[Span]) -> Cost | None:
        """One BT for points, one WT for words and whole sixteens of points.

        None also where two spans overlap: the first value would be acknowledged and lost.
        """
        accesses = scattered_access(self._limits, spans)
        return None if accesses is None else self._ack_cost(_COUNT + listed_characters(accesses))

    async def write_scattered(
        self, talk: LinkTalk, parts: Sequence[tuple[Span, Sequence[int]]]
    ) -> bool:
        spans = [span for span, _ in parts]
        accesses = possible(scattered_access(self._limits, spans), spans)
        pieces = [
            device + piece
            for access, (_, units) in zip(accesses, parts, strict=True)
            for device, piece in zip(access.devices(), access.encode(units), strict=True)
        ]
        command = "WT" if accesses[0].in_words else "BT"
        return await self._ask_ack(talk, command, f"{len(pieces):02X}{''.join(pieces)}")

    # Registered reads (2-7 to 2-10)

    def monitor_cost(self, spans: Sequence[Span]) -> Cost | None:
        """One MB for up to ten points, one MN for up to ten words or sixteens of points."""
        accesses = self._registered(spans)
        return None if accesses is None else self._text_cost(0, data_characters(accesses))

    async def register(self, talk: LinkTalk, spans: Sequence[Span]) -> None:
        """The PLC has one list of points and one of words; each replaces the one before."""
        accesses = possible(self._registered(spans), spans)
        devices = [device for access in accesses for device in access.devices()]
        command = "WM" if accesses[0].in_words else "BM"
        await self._ask_ack(talk, command, f"{len(devices):02X}{''.join(devices)}")

    async def read_registered(self, talk: LinkTalk, spans: Sequence[Span]) -> list[Sequence[int]]:
        accesses = possible(self._registered(spans), spans)
        command = self.monitor_word_command if accesses[0].in_words else "MB"
        characters = data_characters(accesses)
        return await self._ask_text(
            talk, command, "", characters, lambda data: decode_all(accesses, data)
        )

    # Commands (2-11 to 2-13) and resync

    async def control(self, talk: LinkTalk, command: str, argument: str) -> str:
        """Sends `run`, `stop`, `model`; `loopback` with a text; `global` with on or off.

        `global` goes to every station of the line, and no station replies.
        """
        if command not in self.controls:
            raise BadValue(f"{command!r} is none of {', '.join(sorted(self.controls))}")
        if argument and command in ("run", "stop", "model"):
            raise BadValue(f"{command} takes no argument")
        match command:
            case "run" | "stop":
                await self._ask_ack(talk, "RR" if command == "run" else "RS", "")
                return "acknowledged"
            case "loopback":
                return await self._loopback(talk, argument or "ABCDE")
            case "model":
                return await self._ask_text(talk, "PC", "", 2, model_name)
        if argument.lower() not in _SWITCH:
            raise BadValue(f"global takes on or off, not {argument!r}")
        await talk.tell(self._enquiry("GW", _SWITCH[argument.lower()], ALL_STATIONS))
        return "sent to all stations, none answers"

    identity_names: ClassVar = ("model",)

    async def identify(self, talk: LinkTalk, names: Collection[str]) -> Mapping[str, Sequence[str]]:
        """Asks for the model by PC: its code, and its name if that is known."""
        told = await self._ask_text(talk, "PC", "", 2, model_name)
        return {"model": re.findall(r"\w+", told)}

    async def resync(
        self,
        talk: LinkTalk,
        outstanding: Span | None,
        probe_token: int,
        spans: Sequence[Span] = (),
    ) -> int:
        """Sends a loopback, or a read inside the `spans`, as the station answers.

        No data reply has the letter Z of the loopback; the rest is the `probe_token`. A read has
        another length than the `outstanding` one. A NAK names no request: it may be the late reply
        to that read, so one more read of another length follows it.
        """
        reads = self._harmless(outstanding, spans)
        loopback = not reads or self._kind.is_loopback(probe_token)
        with self._kind.sent(probe_token, loopback=loopback):
            if loopback:
                await self._loopback(talk, f"Z{probe_token & 0xFFFF:04X}")
                return EVERY_REQUEST
            told = await resync_by_reads(
                lambda span: self.read(talk, span),
                *(probe_token, outstanding, reads.pick, self.reply_shape),
            )
            return 0 if self.monitor else told  # the length of the reply to a list: not known here

    def _harmless(self, outstanding: Span | None, spans: Sequence[Span]) -> HarmlessReads:
        """Returns short reads inside the spans; if all have one length, around them too."""
        inside = HarmlessReads(spans, outstanding, self.reply_shape)
        if inside:
            return inside
        wider = []
        for area, start, size in spans:
            last = self.areas[area].last
            wider.append(Span(area, max(min(start, last - _WIDER + 1), 0), max(size, _WIDER)))
        return HarmlessReads(wider, outstanding, self.reply_shape)

    # Listening to another master

    @property
    def framing(self) -> Hashable:
        return self.protocol, self.frame_format, self.sum_check

    def traffic_reader(self, character: float) -> TrafficReader:
        return link_traffic_reader(self.frame_format, self.sum_check)

    def learn(self, read: Read, span: Span) -> Learn | None:
        return learn(read, self._limits, span)

    # The shapes of replies

    def reply_shape(self, span: Span) -> Hashable:
        """The number of characters: data names no command and no device."""
        cost = self.cost(span)
        return None if cost is None else cost.reply

    def write_shapes(self, span: Span, units: Sequence[int]) -> Sequence[Hashable]:
        """Every write has the same acknowledgement."""
        return (_ACK,)

    def resync_shape(
        self, outstanding: Span | None, probe_token: int, spans: Sequence[Span] = ()
    ) -> Hashable:
        """None for a loopback: the letter Z and the token are no data of any other reply."""
        reads = self._harmless(outstanding, spans)
        if not reads or probe_token == PROOF or self._kind.is_loopback(probe_token):
            return None
        return self.reply_shape(reads.pick(probe_token))

    def is_reply(self, frame: Frame) -> bool:
        """False for an enquiry, and for on-demand data."""
        own = frame.station == self.station and not isinstance(frame, Enquiry)
        return own and not (isinstance(frame, Text) and frame.pc == PC_ON_DEMAND)

    def describe_stray(self, frame: Frame) -> str | None:
        """Explains on-demand data of the PLC, and the echo of a request."""
        return describe_stray(frame)

    @property
    def _limits(self) -> Profile:
        return PROFILES[self.profile]

    def _registered(self, spans: Sequence[Span]) -> list[Access] | None:
        return monitored_access(self._limits, spans) if self.monitor else None

    async def _loopback(self, talk: LinkTalk, text: str) -> str:
        most = self._limits.loopback
        if not 1 <= len(text) <= most or not (text.isascii() and text.isprintable()):
            raise BadValue(f"loopback takes 1 to {most} printable ASCII characters")
        said = f"{len(text):02X}{text}"
        return await self._ask_text(
            talk, "TT", said, len(said), lambda data: text if data == said else None
        )

    def _enquiry(self, command: str, area: str, station: int | None = None) -> Enquiry:
        to = self.station if station is None else station
        return Enquiry(to, command, area, round(self.message_wait * 100))

    async def _ask_text(
        self,
        talk: LinkTalk,
        command: str,
        area: str,
        characters: int,
        decode: Callable[[str], T | None],
    ) -> T:
        """Requests data; `decode` returns None for data of another request."""
        reply = self._text_cost(len(area), characters).reply
        answer = await talk.ask(
            self._enquiry(command, area), reply, accept_text(self.station, decode)
        )
        if self.send_area_c and not talk.may_echo:  # its echo would acknowledge the next write
            await talk.tell(Ack(self.station))
        return answer

    async def _ask_ack(self, talk: LinkTalk, command: str, area: str) -> bool:
        refusal = self._ack_cost(len(area)).reply + _CODE
        return await talk.ask(self._enquiry(command, area), refusal, accept_ack(self.station))

    def _text_cost(self, area: int, characters: int) -> Cost:
        """The cost with `area` characters in the request and `characters` of data in the reply.

        Request: ENQ, station, PC number, command, wait, area; reply: STX, station, PC number,
        data, ETX; both with sum and CR LF where set. Area C counts as part of the request.
        """
        tail = self._sum + self._end
        confirm = 5 + self._end if self.send_area_c else 0
        return Cost(8 + area + tail + confirm, 6 + characters + tail)

    def _ack_cost(self, area: int) -> Cost:
        return Cost(8 + area + self._sum + self._end, 5 + self._end)

    @property
    def _sum(self) -> int:
        return 2 if self.sum_check else 0

    @property
    def _end(self) -> int:
        return 2 if self.frame_format == 4 else 0
