"""Telnet with COM-PORT-OPTION (RFC 854, 855, 856, 858, 2217), sans I/O: bytes in, events out."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import IntEnum

IAC = 0xFF
_IAC = b"\xff"
_SE, _SB, _WILL, _WONT, _DO, _DONT = 240, 250, 251, 252, 253, 254

BINARY, SUPPRESS_GO_AHEAD, COM_PORT = 0, 3, 44  # the options to agree on; all others are declined
_WANTED = frozenset({BINARY, SUPPRESS_GO_AHEAD, COM_PORT})  # on either side

_LONGEST_SUBNEGOTIATION = 256  # bytes; a longer one is dropped, or it would swallow all data
_MOST_CHANGES = 3  # of one option that are answered
_SERVER = 100  # the server's reply to request n has the number n + 100


class Setting(IntEnum):
    """A setting of the serial port behind the server; RFC 2217, section 3."""

    BAUDRATE = 1
    DATA_BITS = 2
    PARITY = 3
    STOP_BITS = 4
    CONTROL = 5
    MODEM_STATE = 7  # the server reports it by itself
    PURGE = 12


_SETTINGS = frozenset(Setting)
PARITIES = {"N": 1, "O": 2, "E": 3, "M": 4, "S": 5}
PURGE_BOTH = 3  # the receive and the transmit buffer


class Control(IntEnum):
    """Values of `Setting.CONTROL`. The first of each kind asks for the present one."""

    FLOW, NO_FLOW = 0, 1
    BREAK, BREAK_ON, BREAK_OFF = 4, 5, 6
    DTR, DTR_ON, DTR_OFF = 7, 8, 9
    RTS, RTS_ON, RTS_OFF = 10, 11, 12
    INBOUND_FLOW, NO_INBOUND_FLOW = 13, 14


class Consent(IntEnum):
    """The state of the agreement on an option."""

    NO = 0
    ASKED = 1
    YES = 2
    DECLINED = 3


@dataclass(frozen=True, slots=True)
class Received:
    """Bytes from the serial port behind the server."""

    data: bytes


@dataclass(frozen=True, slots=True)
class Send:
    """Bytes to send to the server unchanged."""

    data: bytes


@dataclass(frozen=True, slots=True)
class Agreed:
    """The agreement on one side of an option. `ours`: the client's side."""

    option: int
    ours: bool
    yes: bool


@dataclass(frozen=True, slots=True)
class Acknowledged:
    """The server reports the value of a setting."""

    setting: Setting
    value: int


@dataclass(frozen=True, slots=True)
class Asked:
    """The client asks the server for something: a `Setting`, or another number of RFC 2217."""

    number: int
    data: bytes


Event = Received | Send | Agreed | Acknowledged | Asked


class _State(IntEnum):
    """The position of the next byte in the stream."""

    DATA = 0
    COMMAND = 1  # after IAC
    OPTION = 2  # after IAC WILL, WONT, DO or DONT
    SUBNEGOTIATION = 3  # in a subnegotiation
    SUBNEGOTIATION_COMMAND = 4  # after IAC in a subnegotiation


@dataclass(slots=True)
class Telnet:
    """One end of a telnet connection to a serial port: of the client, or of the server.

    `start` returns the first bytes to send. `feed` accepts received bytes in pieces of any size
    and never raises.
    """

    serves: bool = False

    _state: _State = _State.DATA
    _verb: int = 0
    _body: bytearray = field(default_factory=bytearray)
    _ours: dict[int, Consent] = field(default_factory=dict)
    _theirs: dict[int, Consent] = field(default_factory=dict)
    _changed: dict[tuple[bool, int], int] = field(default_factory=dict)  # by side and option

    def start(self) -> bytes:
        """Returns the offers and requests for the options."""
        both, one = sorted(_WANTED - {COM_PORT}), sorted(_WANTED)
        # The client offers COM-PORT-OPTION (RFC 2217, section 2).
        self._ours = dict.fromkeys(both if self.serves else one, Consent.ASKED)
        self._theirs = dict.fromkeys(one if self.serves else both, Consent.ASKED)
        offers = [bytes((IAC, _WILL, option)) for option in self._ours]
        return b"".join(offers + [bytes((IAC, _DO, option)) for option in self._theirs])

    def consent(self, option: int, *, ours: bool) -> Consent:
        return (self._ours if ours else self._theirs).get(option, Consent.NO)

    @staticmethod
    def encode(data: bytes) -> bytes:
        """Escapes data for the serial port."""
        return data.replace(_IAC, _IAC + _IAC)

    @staticmethod
    def request(setting: Setting, value: int) -> bytes:
        """Returns the request to change a setting; the value 0 asks for the current one."""
        number = value.to_bytes(4 if setting is Setting.BAUDRATE else 1, "big")
        body = bytes((COM_PORT, setting)) + Telnet.encode(number)
        return bytes((IAC, _SB)) + body + bytes((IAC, _SE))

    @staticmethod
    def answer(number: int, data: bytes) -> bytes:
        """Returns the server's answer to `Asked`, or its report."""
        body = bytes((COM_PORT, number + _SERVER)) + Telnet.encode(data)
        return bytes((IAC, _SB)) + body + bytes((IAC, _SE))

    def feed(self, data: bytes) -> list[Event]:
        if self._state is _State.DATA and IAC not in data:
            return [Received(data)] if data else []
        events: list[Event] = []
        plain = bytearray()
        at = 0
        while at < len(data):
            if self._state is _State.DATA:
                mark = data.find(IAC, at)
                plain += data[at:] if mark < 0 else data[at:mark]
                if mark < 0:
                    break
                self._state = _State.COMMAND
                at = mark + 1
                continue
            byte = data[at]
            at += 1
            for event in self._step(byte):
                match event:
                    case Received(more):
                        plain += more
                    case _:
                        if plain:  # events keep the order of the stream
                            events.append(Received(bytes(plain)))
                            plain.clear()
                        events.append(event)
        if plain:
            events.append(Received(bytes(plain)))
        return events

    def _step(self, byte: int) -> Iterator[Event]:
        """Handles one byte that is not plain data."""
        match self._state:
            case _State.SUBNEGOTIATION:
                self._in_subnegotiation(byte)
            case _State.SUBNEGOTIATION_COMMAND if byte in (IAC, _SE):
                yield from self._in_subnegotiation_command(byte)
            case _State.OPTION:
                self._state = _State.DATA
                yield from self._negotiate(self._verb, byte)
            # Another command within a subnegotiation ends it.
            case _:
                yield from self._command(byte)

    def _command(self, byte: int) -> Iterator[Event]:
        self._state = _State.DATA
        if byte == IAC:
            yield Received(_IAC)
        elif byte == _SB:
            self._body.clear()
            self._state = _State.SUBNEGOTIATION
        elif byte in (_WILL, _WONT, _DO, _DONT):
            self._verb = byte
            self._state = _State.OPTION
        # Other commands (NOP, GA, ...) do not concern a serial port.

    def _in_subnegotiation(self, byte: int) -> None:
        if byte == IAC:
            self._state = _State.SUBNEGOTIATION_COMMAND
        elif len(self._body) >= _LONGEST_SUBNEGOTIATION:
            self._state = _State.DATA
        else:
            self._body.append(byte)

    def _in_subnegotiation_command(self, byte: int) -> Iterator[Event]:
        if byte == IAC:
            self._state = _State.SUBNEGOTIATION
            self._body.append(IAC)
            return
        self._state = _State.DATA
        body = bytes(self._body)
        if self.serves and len(body) > 1 and body[0] == COM_PORT:
            yield Asked(body[1], body[2:])
        elif len(body) > 2 and body[0] == COM_PORT and body[1] - _SERVER in _SETTINGS:
            setting = Setting(body[1] - _SERVER)
            yield Acknowledged(setting, int.from_bytes(body[2:], "big"))

    def _negotiate(self, verb: int, option: int) -> Iterator[Event]:
        """Handles WILL and WONT (the server's side), DO and DONT (the client's side).

        Answers only a change: otherwise both ends would answer each other forever (RFC 854).
        """
        ours = verb in (_DO, _DONT)
        yes = verb in (_DO, _WILL)
        agreements = self._ours if ours else self._theirs
        before = agreements.get(option, Consent.NO)
        if yes and option not in _WANTED:
            yield Send(bytes((IAC, _WONT if ours else _DONT, option)))
            return
        if before is Consent.YES if yes else before in (Consent.NO, Consent.DECLINED):
            return
        agreements[option] = Consent.YES if yes else Consent.DECLINED
        self._changed[ours, option] = changes = self._changed.get((ours, option), 0) + 1
        # Two ends that each change their mind would answer each other forever, too (RFC 1143).
        if before is not Consent.ASKED and changes <= _MOST_CHANGES:
            agree, decline = (_WILL, _WONT) if ours else (_DO, _DONT)
            yield Send(bytes((IAC, agree if yes else decline, option)))
        yield Agreed(option, ours, yes)
