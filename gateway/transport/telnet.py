"""Telnet with COM-PORT-OPTION (RFC 854, 855, 856, 858, 2217) without I/O: bytes in, events out."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import IntEnum

IAC = 0xFF
_IAC = b"\xff"
_SE, _SB, _WILL, _WONT, _DO, _DONT = 240, 250, 251, 252, 253, 254

BINARY, SUPPRESS_GO_AHEAD, COM_PORT = 0, 3, 44  # the options we want; all others are declined
_WANTED_OF_US = frozenset({BINARY, SUPPRESS_GO_AHEAD, COM_PORT})
_WANTED_OF_THEM = _WANTED_OF_US

_LONGEST_NOTE = 256  # a subnegotiation that does not end is given up: it would swallow all data
_SERVER = 100  # what a server says has the number of what it answers, plus this


class Setting(IntEnum):
    """What a client asks of the port behind a server; RFC 2217, section 3."""

    BAUDRATE = 1
    DATA_BITS = 2
    PARITY = 3
    STOP_BITS = 4
    PURGE = 12


_SETTINGS = frozenset(Setting)
PARITIES = {"N": 1, "O": 2, "E": 3, "M": 4, "S": 5}
PURGE_BOTH = 3  # what was received and what waits to be sent


class Consent(IntEnum):
    """How far an option has been agreed."""

    NO = 0
    ASKED = 1
    YES = 2
    DECLINED = 3


@dataclass(frozen=True, slots=True)
class Received:
    """Bytes from the serial port behind the server."""

    data: bytes


@dataclass(frozen=True, slots=True)
class Answer:
    """To be sent to the server as it is."""

    data: bytes


@dataclass(frozen=True, slots=True)
class Agreed:
    """One side of an option has been settled. `ours`: it is about what we do."""

    option: int
    ours: bool
    yes: bool


@dataclass(frozen=True, slots=True)
class Acknowledged:
    """The server says what a setting now is."""

    setting: Setting
    value: int


Event = Received | Answer | Agreed | Acknowledged


class _At(IntEnum):
    """Where in the stream the next byte is."""

    DATA = 0
    COMMAND = 1  # after IAC
    OPTION = 2  # after IAC WILL, WONT, DO or DONT
    NOTE = 3  # in a subnegotiation
    NOTE_COMMAND = 4  # after IAC in a subnegotiation


@dataclass(slots=True)
class Telnet:
    """The client's end of one telnet connection to a serial port.

    `start` gives what to send first, `feed` takes what arrives in pieces of any size and
    never raises.
    """

    _at: _At = _At.DATA
    _verb: int = 0
    _note: bytearray = field(default_factory=bytearray)
    _ours: dict[int, Consent] = field(default_factory=dict)
    _theirs: dict[int, Consent] = field(default_factory=dict)

    def start(self) -> bytes:
        """What we offer and what we ask for."""
        self._ours = dict.fromkeys(sorted(_WANTED_OF_US), Consent.ASKED)
        # COM-PORT-OPTION is the client's to offer (RFC 2217, section 2).
        self._theirs = dict.fromkeys(sorted(_WANTED_OF_THEM - {COM_PORT}), Consent.ASKED)
        offers = [bytes((IAC, _WILL, option)) for option in self._ours]
        return b"".join(offers + [bytes((IAC, _DO, option)) for option in self._theirs])

    def consent(self, option: int, *, ours: bool) -> Consent:
        return (self._ours if ours else self._theirs).get(option, Consent.NO)

    @staticmethod
    def encode(data: bytes) -> bytes:
        """Data for the serial port as it travels."""
        return data.replace(_IAC, _IAC + _IAC)

    @staticmethod
    def request(setting: Setting, value: int) -> bytes:
        """Ask for a setting; a value of 0 asks what it is."""
        number = value.to_bytes(4 if setting is Setting.BAUDRATE else 1, "big")
        note = bytes((COM_PORT, setting)) + Telnet.encode(number)
        return bytes((IAC, _SB)) + note + bytes((IAC, _SE))

    def feed(self, data: bytes) -> list[Event]:
        if self._at is _At.DATA and IAC not in data:
            return [Received(data)] if data else []
        events: list[Event] = []
        plain = bytearray()
        at = 0
        while at < len(data):
            if self._at is _At.DATA:
                mark = data.find(IAC, at)
                plain += data[at:] if mark < 0 else data[at:mark]
                if mark < 0:
                    break
                self._at = _At.COMMAND
                at = mark + 1
                continue
            byte = data[at]
            at += 1
            for event in self._step(byte):
                match event:
                    case Received(more):
                        plain += more
                    case _:
                        if plain:  # what came first is told first
                            events.append(Received(bytes(plain)))
                            plain.clear()
                        events.append(event)
        if plain:
            events.append(Received(bytes(plain)))
        return events

    def _step(self, byte: int) -> Iterator[Event]:
        """One byte that is not plain data."""
        match self._at:
            case _At.NOTE:
                self._in_note(byte)
            case _At.NOTE_COMMAND if byte in (IAC, _SE):
                yield from self._in_note_command(byte)
            case _At.OPTION:
                self._at = _At.DATA
                yield from self._negotiate(self._verb, byte)
            # A subnegotiation broken off by another command is forgotten.
            case _:
                yield from self._command(byte)

    def _command(self, byte: int) -> Iterator[Event]:
        self._at = _At.DATA
        if byte == IAC:
            yield Received(_IAC)
        elif byte == _SB:
            self._note.clear()
            self._at = _At.NOTE
        elif byte in (_WILL, _WONT, _DO, _DONT):
            self._verb = byte
            self._at = _At.OPTION
        # All others (NOP, GA, ...) say nothing about a serial port.

    def _in_note(self, byte: int) -> None:
        if byte == IAC:
            self._at = _At.NOTE_COMMAND
        elif len(self._note) >= _LONGEST_NOTE:
            self._at = _At.DATA
        else:
            self._note.append(byte)

    def _in_note_command(self, byte: int) -> Iterator[Event]:
        if byte == IAC:
            self._at = _At.NOTE
            self._note.append(IAC)
            return
        self._at = _At.DATA
        note = bytes(self._note)
        if len(note) > 2 and note[0] == COM_PORT and note[1] - _SERVER in _SETTINGS:
            setting = Setting(note[1] - _SERVER)
            yield Acknowledged(setting, int.from_bytes(note[2:], "big"))

    def _negotiate(self, verb: int, option: int) -> Iterator[Event]:
        """WILL and WONT are about them, DO and DONT about us. Only a change is answered,
        or two polite ends would answer each other for ever (RFC 854)."""
        ours = verb in (_DO, _DONT)
        yes = verb in (_DO, _WILL)
        book, wanted = (self._ours, _WANTED_OF_US) if ours else (self._theirs, _WANTED_OF_THEM)
        before = book.get(option, Consent.NO)
        if yes and option not in wanted:
            yield Answer(bytes((IAC, _WONT if ours else _DONT, option)))
            return
        if before is Consent.YES if yes else before in (Consent.NO, Consent.DECLINED):
            return
        book[option] = Consent.YES if yes else Consent.DECLINED
        if before is not Consent.ASKED:
            agree, decline = (_WILL, _WONT) if ours else (_DO, _DONT)
            yield Answer(bytes((IAC, agree if yes else decline, option)))
        yield Agreed(option, ours, yes)
