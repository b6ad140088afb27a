"""Health of one device: a state machine that says when it is polled, probed, or left alone.

The table `TRANSITIONS` holds every change of state. No other module assigns a field of `Health`.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from gateway.errors import DeviceError, Evidence, Garbled, GatewayError, LineDown, NoReply
from gateway.protocols.driver import Span
from gateway.tags import Reason

PAUSE_FIRST, PAUSE_LONGEST = 1.0, 60.0  # seconds between two probes of an offline device
MOST_UNANSWERED = 64  # unanswered requests whose times are kept


class State(StrEnum):
    """How far a device can be trusted to answer."""

    STARTING = "starting"  # no reply since the line was opened
    ONLINE = "online"  # its last transaction ended with a reply
    FAILING = "failing"  # its last transaction ended unclear; its polls go on
    OFFLINE = "offline"  # it is only probed, at growing pauses


class Event(StrEnum):
    """What changes the state."""

    ANSWERED = "answered"  # a transaction ended with a reply, good or "no"
    UNCLEAR = "unclear"  # a transaction ended without one
    GAVE_UP = "gave up"  # it did so once more than `retries` allows
    RESTARTED = "restarted"  # the line was opened, or lost


_S, _E = State, Event
TRANSITIONS: Mapping[tuple[State, Event], State] = {
    (_S.STARTING, _E.ANSWERED): _S.ONLINE,
    (_S.ONLINE, _E.ANSWERED): _S.ONLINE,
    (_S.FAILING, _E.ANSWERED): _S.ONLINE,
    (_S.OFFLINE, _E.ANSWERED): _S.ONLINE,
    (_S.STARTING, _E.UNCLEAR): _S.STARTING,
    (_S.ONLINE, _E.UNCLEAR): _S.FAILING,
    (_S.FAILING, _E.UNCLEAR): _S.FAILING,
    (_S.OFFLINE, _E.UNCLEAR): _S.OFFLINE,
    (_S.STARTING, _E.GAVE_UP): _S.OFFLINE,
    (_S.ONLINE, _E.GAVE_UP): _S.OFFLINE,
    (_S.FAILING, _E.GAVE_UP): _S.OFFLINE,
    (_S.OFFLINE, _E.GAVE_UP): _S.OFFLINE,
    (_S.STARTING, _E.RESTARTED): _S.STARTING,
    (_S.ONLINE, _E.RESTARTED): _S.STARTING,
    (_S.FAILING, _E.RESTARTED): _S.STARTING,
    (_S.OFFLINE, _E.RESTARTED): _S.STARTING,
}


@dataclass(slots=True, eq=False)
class Health:
    """The state of one device, and what is known of replies that may still arrive.

    `answerable` is False for a device that is only written to or only speaks unsolicited: it
    is never probed.
    """

    answerable: bool = True
    state: State = State.STARTING
    online: bool = False  # online or failing: its blocks are polled
    consecutive_failures: int = 0
    needs_resync: bool = field(init=False)  # the next frame may answer an older request
    outstanding: Span | None = None  # the request whose reply may still arrive
    trouble: GatewayError | None = None
    pause: float = 0.0  # seconds until the next probe of an offline device
    next_probe: float = 0.0
    _unanswered: deque[float] = field(default_factory=lambda: deque(maxlen=MOST_UNANSWERED))
    _probe_token: int = 0

    def __post_init__(self) -> None:
        self.needs_resync = self.answerable

    def restart(self, trouble: LineDown | None = None) -> None:
        """The line was opened, or lost: a reply from before may still arrive."""
        self._move(Event.RESTARTED)
        self.trouble = trouble
        self.consecutive_failures = 0
        self.needs_resync = self.answerable

    def answered(self) -> bool:
        """A transaction ended with a reply. Returns True when the device comes online."""
        came = not self.online
        self._move(Event.ANSWERED)
        self.consecutive_failures = 0
        self.needs_resync = False
        self.outstanding = self.trouble = None
        self.pause = 0.0
        self._unanswered.clear()
        return came

    def unclear(self, error: DeviceError, outstanding: Span | None, now: float) -> None:
        """A transaction ended unclear; its reply may still arrive.

        `outstanding`: what was asked; None for a probe, which leaves an older one as it was.
        """
        self._move(Event.UNCLEAR)
        self.consecutive_failures += 1
        self._unanswered.append(now)
        if not (self._slow and isinstance(error, NoReply)):
            self.trouble = error  # "too slow" says more than "no reply": the line waits no longer
        self.needs_resync = self.answerable
        if outstanding is not None:
            self.outstanding = outstanding

    def left_outstanding(self, outstanding: Span | None) -> None:
        """The port was lost in the middle of a transaction."""
        self.needs_resync = self.answerable
        if outstanding is not None:
            self.outstanding = outstanding

    def replied_late(self, took: float, reply_timeout: float, *, last: bool) -> None:
        """The right reply arrived after its time-out, `took` seconds after the request.

        `last`: no other request can still be answered, so the next frame is no older reply.
        """
        if last:
            self.needs_resync = False
            self._unanswered.clear()
        self.trouble = Garbled(
            f"it took {took:.2f} s, reply_timeout is {reply_timeout:g} s", evidence=Evidence.SLOW
        )

    def gave_up(self, now: float, spread: float) -> None:
        """The device goes offline, or stays so: the pause before its next probe doubles.

        `spread`: a factor about 1 that keeps probes of many devices apart.
        """
        self._move(Event.GAVE_UP)
        self.pause = min(max(2 * self.pause, PAUSE_FIRST), PAUSE_LONGEST)
        self.next_probe = now + self.pause * spread

    def probe_soon(self) -> None:
        """A client waits for the device: probe it as soon as the share of the wire allows."""
        self.next_probe = 0.0

    def next_probe_token(self) -> int:
        """For a resync. The token after it stays free, for asking once more."""
        self._probe_token += 2
        return self._probe_token

    def outstanding_requests(self, since: float) -> int:
        """How many requests sent after `since` have no reply."""
        return sum(sent > since for sent in self._unanswered)

    @property
    def reason(self) -> Reason:
        """Why its values are bad."""
        return Reason.GARBLED if isinstance(self.trouble, Garbled) else Reason.NO_REPLY

    @property
    def _slow(self) -> bool:
        trouble = self.trouble
        return isinstance(trouble, Garbled) and trouble.evidence is Evidence.SLOW

    def _move(self, event: Event) -> None:
        self.state = TRANSITIONS[self.state, event]
        self.online = self.state in (State.ONLINE, State.FAILING)

    # Bytes of a device that only speaks unsolicited

    def understood(self) -> None:
        """It was understood again."""
        self.trouble = None

    def not_understood(self, damage: Garbled) -> None:
        """It spoke, but not in whole frames."""
        self.trouble = damage


def diagnosis(trouble: GatewayError | None, silent_causes: str) -> str:
    """One sentence for people: the likely cause of the trouble; empty when there is none.

    `silent_causes`: what the protocol knows of devices that do not answer.
    """
    match trouble:
        case None:
            return ""
        case Garbled() as error:
            return f"{_ADVICE.get(error.evidence, 'not understood')} ({error})"
        case NoReply():
            return f"{_SILENCE} {silent_causes}".strip()
        case error:
            return str(error)


_SILENCE = (
    "No byte came back: check power, wiring (A and B), station number, baud rate and that no "
    "other master is on the line."
)
_ADVICE = {
    Evidence.ECHO: "Only our own request came back: the adapter echoes; set `echo: true`, "
    "and the station itself is silent",
    Evidence.NOISE: "Bytes came that are no frame: check baud rate, parity and data bits",
    Evidence.CHECKSUM: "Frames come with a wrong sum: noise, missing termination, or sum check "
    "set differently on both sides",
    Evidence.STATION: "Another station answered: check the station numbers",
    Evidence.SHAPE: "The answer was to some other question, or in another format",
    Evidence.SLOW: "It answers, but too late: raise reply_timeout",
    Evidence.TRUNCATED: "Answers break off: noise, or a device server that cuts packets",
}
