"""The AT commands of a modem, as a synchronous state machine.

Bytes of the modem and the time go in; commands to send, data of the call and events come out. The
commands are those of ITU-T V.250, which every modem since Hayes takes.
"""

import re

from gateway.transport.modem_events import (
    Broken,
    Connected,
    Ended,
    Event,
    Failed,
    ModemSettings,
    Pins,
    Ready,
    Received,
    Send,
    SetDtr,
    State,
    dial_command,
)

NEVER = float("inf")
SETUP = "ATE0V1Q0"  # no echo; results, and as words
KEEP_SILENT = "ATS0=0"  # the modem takes no call by itself
HANG_UP, ANSWER, ESCAPE = "ATH", "ATA", "+++"
# A modem needs a pause between its result and the next command (V.250 5.2.1 gives no number).
PAUSE = 0.15  # seconds
ESCAPE_WAIT = 1.0  # seconds for the result of +++, after the guard time
ABORT_WAIT = 2.0  # seconds for the result of a dial that was broken off
DTR_TIME = 0.6  # seconds without DTR; S25 of a modem is 50 ms
RING_TIME = 6.0  # seconds between two rings, at most
LOST = b"\r\nNO CARRIER"  # the modem's own text in the middle of the data
CARRIER_WAIT = 0.6  # seconds in which the signal CD must follow that text
_REFUSALS = (
    *("BUSY", "NO CARRIER", "NO DIALTONE", "NO ANSWER", "ERROR", "DELAYED", "BLACKLISTED"),
    *("VOICE", "FAX", "+CME ERROR", "+FCERROR"),
)
_LINE_END = re.compile(rb"[\r\n]")
_MOST_KEPT = 256  # bytes of one line of the modem
_AFTER = (SETUP, KEEP_SILENT)  # after the init strings, which may change them
MOST_ESCAPES = 2  # in one hang-up
CALLING = (State.ONLINE, State.DIALLING, State.RINGING, State.ANSWERING, State.ABORTING)


class AtModem:
    """One modem. Call `tick` at `due`, `open` first, `dial` and `hang_up` when `Ready` came."""

    def __init__(self, settings: ModemSettings, *, answers: bool = False) -> None:
        """`answers`: takes incoming calls."""
        self.state = State.CLOSED
        self.due = NEVER
        self.pins = Pins()
        self._settings = settings
        self._answers = answers
        self._line = b""  # the begun line of the modem
        self._held = b""  # data that may be the beginning of the modem's own text
        self._commands: list[str] = []  # to be sent before the modem is ready
        self._escapes = 0  # of this hang-up
        self._then: Event = Ready()  # the event at the end of the hang-up
        self._heard = 0.0  # the last data of the call
        self._rang = -NEVER
        self._waking = True  # it was never ready
        self._begun = False  # the first data of a call may be the rest of the modem's line end
        self._events: list[Event] = []

    # Requests

    def open(self, now: float) -> list[Event]:
        """Begins: the modem may still be in a call of before."""
        self._escapes = 0
        self._command(SETUP, State.WAKING, now + 2.0)
        return self._taken()

    def dial(self, now: float) -> list[Event]:
        """Dials the number. `Connected` or `Failed` follows."""
        if why := self._why_no_dial(now):
            self._events.append(Failed(why))
        else:
            command, timeout = dial_command(self._settings.number), self._settings.dial_timeout
            self._command(command, State.DIALLING, now + timeout)
        return self._taken()

    def ring(self, number: str, now: float) -> list[Event]:
        """Dials a telephone, and hangs up. `Ready` or `Failed` follows.

        `;` behind the number: the modem says OK when it has dialled, and waits for no carrier.
        """
        if why := self._why_no_dial(now):
            self._events.append(Failed(why))
        else:
            command = f"{dial_command(number)};"
            self._command(command, State.RINGING, now + self._settings.dial_timeout)
        return self._taken()

    def hang_up(self, now: float) -> list[Event]:
        """Ends the call, or the dial. `Ready` or `Broken` follows."""
        if self.state is State.READY:
            self._events.append(Ready())
        elif self.state in CALLING:
            self._begin_hang_up(Ready(), now)
        return self._taken()

    def carrier_lost(self) -> list[Event]:
        """Takes the loss of the signal CD in a call."""
        if self.state is State.ONLINE:
            self._lost("NO CARRIER (the signal CD is off)")
        return self._taken()

    def _why_no_dial(self, now: float) -> str:
        if self.state is not State.READY:
            return "the modem is not ready"
        return "RING: an incoming call" if now < self._rang + RING_TIME else ""  # ATD would take it

    # Bytes and time

    def feed(self, data: bytes, now: float) -> list[Event]:
        """Takes bytes of the modem."""
        while data:
            if self.state is State.ONLINE:
                self._data(data, now)
                break
            end = _LINE_END.search(data)
            if end is None:
                self._line = (self._line + data)[-_MOST_KEPT:]
                break
            line, data = self._line + data[: end.start()], data[end.end() :]
            self._line = b""
            if text := line.decode("ascii", "replace").strip():
                self._take(text, now)
        return self._taken()

    def tick(self, now: float) -> list[Event]:
        """Takes the time."""
        if now < self.due:
            return []
        self.due = NEVER
        if self.state in (State.WAKING, State.PAUSING, State.STARTING):
            self._tick_setup(now)
        elif self.state in CALLING:
            self._tick_call(now)
        else:
            self._tick_hang_up(now)
        return self._taken()

    def _tick_setup(self, now: float) -> None:
        match self.state:
            case State.WAKING:
                self._begin_hang_up(Ready(), now)  # it may be in a call of before
            case State.PAUSING:
                until = now + self._settings.command_timeout
                self._command(self._commands[0], State.STARTING, until)
            case _:
                self._break(f"does not answer {self._place}")

    def _tick_call(self, now: float) -> None:
        match self.state:
            case State.ONLINE:
                self._online(now)
            case State.ABORTING:
                self._begin_hang_up(self._then, now)
            case state:
                what = "OK" if state is State.RINGING else "carrier"
                why = f"no {what} within {self._settings.dial_timeout:g} s"
                self._then = Ready() if state is State.ANSWERING else Failed(why)
                self._events.append(Send(b"\r"))  # any character breaks off the dial
                self.state, self.due = State.ABORTING, now + ABORT_WAIT

    def _tick_hang_up(self, now: float) -> None:
        settings = self._settings
        match self.state:
            case State.DROPPING:
                self._events.append(SetDtr(True))
                self.state, self.due = State.RAISED, now + PAUSE
            case State.RAISED:
                self._command(HANG_UP, State.HANGING_UP, now + ABORT_WAIT)
            case State.GUARDING:
                self._escapes += 1
                self._events.append(Send(ESCAPE.encode()))
                self.state, self.due = State.ESCAPING, now + settings.guard + ESCAPE_WAIT
            case State.ESCAPING:
                self._command(HANG_UP, State.HANGING_UP, now + settings.command_timeout)
            case State.CARRIER_GONE:
                self._hung_up(now)
            case State.SAID_GONE:  # a number would go to the station as data
                self._escapes, self._then = 0, Ready()
                self._command(SETUP, State.WAKING, now + 2.0)
            case _ if self._escapes < MOST_ESCAPES:
                self._guard(now)
            case _ if self._waking:
                self._break("does not answer AT commands: check cable, power and baud rate")
            case _:
                self._break("does not hang up")

    # Lines of the modem

    def _take(self, text: str, now: float) -> None:
        """Takes one line of the modem. An echo of a command is no result."""
        word = text.upper().replace("NO DIAL TONE", "NO DIALTONE")
        if word.startswith("CONNECT"):
            self._take_connect(text, now)
        elif word in ("OK", "0"):  # 0: OK of a modem whose results are numbers yet
            self._take_ok(now)
        elif word == "RING" and self.state is State.READY:
            self._rang = now
            if self._answers:
                timeout = self._settings.dial_timeout
                self._command(ANSWER, State.ANSWERING, now + timeout)
        elif word.startswith(_REFUSALS):
            self._take_refusal(text, now)

    def _take_connect(self, text: str, now: float) -> None:
        match self.state:
            case State.DIALLING | State.ANSWERING:
                self._connected(text, now)
            case State.READY if self._answers:
                self._connected(text, now)
            case State.READY:  # it took a call by itself: a number would go to a stranger as data
                self._begin_hang_up(Ready(), now)
            case State.RINGING:  # a modem has answered
                self._begin_hang_up(Ready(), now)
            case State.ABORTING:
                self._begin_hang_up(self._then, now)

    def _take_ok(self, now: float) -> None:
        match self.state:
            case State.WAKING:
                self._start(now)
            case State.STARTING:
                self._commands.pop(0)
                self._next_command(now)
            case State.RINGING:
                self._then, self._escapes = Ready(), 0
                self._command(HANG_UP, State.HANGING_UP, now + self._settings.command_timeout)
            case State.ABORTING | State.ESCAPING:
                self._command(HANG_UP, State.HANGING_UP, now + self._settings.command_timeout)
            case State.HANGING_UP | State.CARRIER_GONE:
                self._hung_up(now)

    def _take_refusal(self, text: str, now: float) -> None:
        match self.state:
            case State.STARTING if self._commands[0] == KEEP_SILENT:
                self._commands.pop(0)  # a modem that never takes a call
                self._next_command(now)
            case State.STARTING:
                self._break(f"answers {text} to {self._place}")
            case State.DIALLING | State.RINGING:
                self._events.append(Failed(text))
                self._rest()
            case State.ANSWERING:  # the caller hung up
                self._rest()
            case State.ABORTING | State.ESCAPING:
                self._command(HANG_UP, State.HANGING_UP, now + self._settings.command_timeout)
            case State.HANGING_UP | State.CARRIER_GONE if text.upper() == "NO CARRIER":
                self.state, self.due = State.CARRIER_GONE, now + 2 * PAUSE

    @property
    def _place(self) -> str:
        """The present init string: only its number, because it may hold a PIN."""
        init = len(self._settings.init)
        sent = 1 + init + len(_AFTER) - len(self._commands)
        return self._commands[0] if sent > init else f"init string {sent} of {init}"

    def _start(self, now: float) -> None:
        self._commands = [*self._settings.init, *_AFTER]
        self._next_command(now)

    def _next_command(self, now: float) -> None:
        if self._commands:
            self.state, self.due = State.PAUSING, now + PAUSE
        else:
            self._waking = False
            self._events.append(Ready())
            self._rest()

    def _command(self, text: str, state: State, until: float) -> None:
        self._line = b""
        self._events.append(Send(f"{text}\r".encode("ascii")))
        self.state, self.due = state, until

    def _rest(self) -> None:
        self.state, self.due, self._held = State.READY, NEVER, b""

    def _break(self, why: str) -> None:
        self._events.append(Broken(f"the modem {why}"))
        self.state, self.due, self._held = State.CLOSED, NEVER, b""

    # The call

    def _connected(self, text: str, now: float) -> None:
        self._events.append(Connected(text))
        self.state, self._held, self._begun, self._heard = State.ONLINE, b"", False, now
        self.pins.carrier = False
        self._set_due()

    def _data(self, data: bytes, now: float) -> None:
        """Passes data on, except what may be the beginning of the modem's own text."""
        if not self._begun:  # the line feed of CONNECT
            self._begun, data = True, data.removeprefix(b"\n")
        self._heard = now
        data = self._held + data
        place = data.find(LOST)
        if place >= 0:
            self._received(data[:place])
            if self.pins.carrier:  # a station may say so, too: the signal tells
                self._held, self.due = data[place:], min(self.due, now + CARRIER_WAIT)
                return
            self._lost("NO CARRIER")
            if not self._answers:
                self.state, self.due = State.SAID_GONE, now + 2 * PAUSE
            return
        kept = _suffix(data)
        self._held = data[len(data) - kept :]
        self._received(data[: len(data) - kept])
        self._set_due()

    def _received(self, data: bytes) -> None:
        if data:
            self._events.append(Received(data))

    def _lost(self, why: str) -> None:
        """Ends the call. Held bytes are dropped: they are the modem's, or end a broken frame."""
        self._events.append(Ended(why))
        self._rest()

    def _online(self, now: float) -> None:
        if self._held and (self._held.startswith(LOST) or self._heard + self._settings.hold <= now):
            held, self._held = self._held, b""
            self._received(held)
        if self._answers and self._heard + self._settings.idle <= now:
            self._begin_hang_up(Ended(f"the caller was silent for {self._settings.idle:g} s"), now)
        else:
            self._set_due()

    def _set_due(self) -> None:
        idle = self._settings.idle if self._answers else NEVER
        self.due = self._heard + (self._settings.hold if self._held else idle)

    # The end of a call

    def _begin_hang_up(self, then: Event, now: float) -> None:
        """`then` is reported when the modem has hung up."""
        self._then, self._escapes, self._held = then, 0, b""
        if self.pins.dtr:
            self._events.append(SetDtr(False))
            self.state, self.due = State.DROPPING, now + DTR_TIME
        else:
            self._guard(now)

    def _guard(self, now: float) -> None:
        self.state, self.due, self._line = State.GUARDING, now + self._settings.guard, b""

    def _hung_up(self, now: float) -> None:
        if self._waking:  # it is not set up yet
            self._start(now)
            return
        self._events.append(self._then)
        self._rest()

    def _taken(self) -> list[Event]:
        events, self._events = self._events, []
        return events


def _suffix(data: bytes) -> int:
    """Returns the length of the longest end of `data` that begins the modem's text."""
    most = min(len(data), len(LOST) - 1)
    return next((size for size in range(most, 0, -1) if data.endswith(LOST[:size])), 0)
