"""Health of one device: a state machine that decides if the device is polled or probed.

The table `TRANSITIONS` holds every change of state. No other module assigns a field of `Health`.
"""

import math
from collections import deque
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum, StrEnum
from typing import Any

from gateway.engine.device.probe_pace import ProbePace
from gateway.errors import (
    NO_TROUBLE,
    DeviceError,
    Diagnosis,
    Evidence,
    Garbled,
    GatewayError,
    LineDown,
    NoReply,
)
from gateway.protocols.driver import Span
from gateway.tags import Reason

FORGOTTEN = 60.0  # seconds after which the reply to a write of a device that is not read is lost
MOST_UNANSWERED = 64  # unanswered requests whose times are kept


class State(StrEnum):
    """States of a device. Only an online or failing device is polled."""

    STARTING = "starting"  # no reply since the line was opened
    ONLINE = "online"  # its last transaction ended with a reply
    FAILING = "failing"  # its last transaction ended unclear; its polls go on
    OFFLINE = "offline"  # it is only probed, at growing pauses


class Event(StrEnum):
    """Events that change the state."""

    ANSWERED = "answered"  # a transaction ended with a reply, perhaps an error reply
    UNCLEAR = "unclear"  # a transaction ended without a reply
    GAVE_UP = "gave up"  # more transactions ended without a reply than `retries` allows
    RESTARTED = "restarted"  # the line was opened, or lost


class Heard(Enum):
    """The last that was heard of a device, also before the line was opened again."""

    NEVER = 0  # it has not replied yet
    REPLIED = 1
    GAVE_UP = 2  # it replied no longer


OF_THE_WIRE = (Evidence.NOISE, Evidence.CHECKSUM, Evidence.TRUNCATED)
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
class Outstanding:
    """The requests whose replies may still arrive."""

    sent: deque[float] = field(default_factory=lambda: deque(maxlen=MOST_UNANSWERED))
    # Their spans, but those of resyncs; None: a request that may have had any shape.
    spans: set[Span | None] = field(default_factory=set)
    # The shapes of second requests of resyncs.
    seconds: deque[Hashable] = field(default_factory=lambda: deque(maxlen=MOST_UNANSWERED))
    either: int = 0  # of any shape: the reply to the request, or to the resync that went with it

    def add(self, span: Span | None, now: float) -> None:
        self.sent.append(now)
        self.spans.add(span)
        self.either += span is None

    def clear(self) -> None:
        self.sent.clear()
        self.spans.clear()
        self.seconds.clear()
        self.either = 0


@dataclass(slots=True)
class Presence:
    """The devices of a line that are not online, as they were at the last look."""

    absent: Sequence[Any] = ()
    changed: bool = True

    def note(self) -> None:
        self.changed = True

    def look(self, devices: Sequence[Any]) -> None:
        self.changed = False
        self.absent = [device for device in devices if not device.health.online]


@dataclass(slots=True, eq=False)
class Health:
    """The state of one device, and its outstanding requests.

    `answerable` is False for a device that is only written to, or only sends unsolicited frames:
    the line does not probe it. `only_written`: it replies, but nothing of it is read. Its first
    write needs no reply before; after an unclear one a probe, or `FORGOTTEN` seconds of silence.
    """

    answerable: bool = True
    only_written: bool = False
    state: State = State.STARTING
    online: bool = False  # online or failing: its blocks are polled
    consecutive_failures: int = 0
    needs_resync: bool = field(init=False)  # the next frame may answer an older request
    outstanding: Span | None = None  # the request whose reply may still arrive
    trouble: GatewayError | None = None
    heard: Heard = Heard.NEVER
    probes: ProbePace = field(default_factory=ProbePace)
    unanswered: Outstanding = field(default_factory=Outstanding)
    _asked_at: float = -math.inf  # when a request ended unclear last, before it was offline
    _extra: bool = False  # an extra reply arrived since the last resync
    # A device server may hold requests to its station that this device never sent.
    inherits: bool = False
    _presence: Presence = field(default_factory=Presence)  # of the devices of its line

    def __post_init__(self) -> None:
        self.needs_resync = self.is_probed

    def report(self, presence: Presence) -> None:
        """Reports there from now on when it comes online, or is no longer online."""
        self._presence = presence
        presence.note()

    def inherit(self, *, inherits: bool = True) -> None:
        """Notes that a device server may have kept earlier requests to the station, or that it has
        none any more: the wire was quiet for long before a resync."""
        self.inherits = inherits

    def restart(self, trouble: LineDown | None = None) -> None:
        """Starts again after the line was opened or lost: an older reply may still arrive."""
        self._move(Event.RESTARTED)
        self.trouble = trouble
        self.consecutive_failures = 0
        self.probes.restart()
        self.needs_resync = self.is_probed or (self.only_written and bool(self.unanswered.sent))

    def reconnected(self) -> None:
        """Notes a new telephone call to an otherwise unchanged device."""
        self.needs_resync = self.is_probed

    def answered(self, *, resynced: bool = False) -> bool:
        """Notes a reply. Returns True if the device comes online.

        `resynced`: it is the reply to a resync. After an extra reply only this one counts.
        """
        came = not self.online
        if resynced:
            self._extra = False
        self._move(Event.ANSWERED)
        self.consecutive_failures = 0
        self.probes.replied()
        self.heard, self.trouble = Heard.REPLIED, None
        if not self._extra:
            self.needs_resync = False
            self._clear()
        return came

    def _clear(self) -> None:
        """Notes that no reply to an older request may arrive any more."""
        self.outstanding = None
        self.unanswered.clear()

    def unclear(
        self,
        error: DeviceError,
        outstanding: Span | None,
        now: float,
        *,
        known: bool = False,
        resynced: bool = False,
    ) -> None:
        """Notes a transaction without a reply, which may still arrive.

        `outstanding`: the requested span. None for a probe: an older span stays outstanding.
        `known`: its reply has the shape of that span, of an acknowledgement, or one of all resyncs.
        `resynced`: a resync went with it.
        """
        if self.state is not State.OFFLINE:
            self._asked_at = now
        self._move(Event.UNCLEAR)
        self.consecutive_failures += 1
        if isinstance(error, Garbled) and error.evidence in OF_THE_WIRE:
            self.probes.replied_damaged(now)
        if isinstance(error, Garbled) and error.evidence in (Evidence.SHAPE, Evidence.SLOW):
            self.probes.replied_late(now)
        if known and outstanding is None:
            self.unanswered.sent.append(now)
        else:
            self.unanswered.add(outstanding if known else None, now)
            self.unanswered.either += known and resynced
        if not (self._slow and isinstance(error, NoReply)):
            self.trouble = error  # "too slow" says more than "no reply": the line waits no longer
        self.needs_resync = self.answerable
        if outstanding is not None:
            self.outstanding = outstanding

    def answered_twice(self, outstanding: Span | None, now: float) -> None:
        """Notes an extra reply: the next reply may be another one. Only a resync ends this."""
        self._extra = True
        self.left_outstanding(outstanding, now)

    def left_outstanding(self, outstanding: Span | None, now: float) -> None:
        """Notes a request whose reply may still arrive, although nothing waits for it."""
        self.needs_resync = self.answerable
        self.unanswered.add(outstanding, now)
        if outstanding is not None:
            self.outstanding = outstanding

    def replied_late(self, took: float, reply_timeout: float, now: float, *, last: bool) -> None:
        """Notes the correct reply after its time-out, `took` seconds after the request.

        `last`: no other request is outstanding, so the next frame is no older reply.
        """
        self.probes.replied_late(now)
        if last and not self._extra:
            self.needs_resync = False
            self._clear()
        self.trouble = Garbled(
            f"it took {took:.2f} s, reply_timeout is {reply_timeout:g} s", evidence=Evidence.SLOW
        )

    def gave_up(self, now: float, spread: float) -> None:
        """Makes the device offline, and doubles the pause before its next probe.

        `spread`: a random factor near 1, so that many devices are not probed at once.
        """
        self._move(Event.GAVE_UP)
        self.heard = Heard.GAVE_UP
        self.probes.grow(now, spread)
        if self.only_written and now - self._asked_at >= FORGOTTEN:
            self.unanswered.clear()
            self.restart()

    def replied_to_older(self, now: float, *, absent: bool = False) -> None:
        """Applies a frame of an offline device behind a network, which no request waits for.

        `absent`: a gateway there says that the device did not reply.
        """
        if self.state is State.OFFLINE and self.unanswered.sent:
            sent = self.unanswered.sent.popleft()
            if absent and sent > self._asked_at:  # a probe: it asks for no silent address
                self.probes.absent(now, now - sent)
            else:
                self.probes.behind(now, now - sent, more=bool(self.unanswered.sent))

    def spoke(self, now: float, longest_reply: float, *, alone: bool = False) -> None:
        """Notes a sound frame, perhaps of an offline device. `alone`: no other one is online."""
        if self.unanswered.sent:
            self.probes.replied_behind(now, now - self.unanswered.sent[-1])
        if self.state is State.OFFLINE:
            self.probes.spoke(now, longest_reply, alone=alone)

    @property
    def is_probed(self) -> bool:
        """True if it is probed before anything else is sent to it."""
        return self.answerable and not self.only_written

    def next_probe_token(self) -> int:
        """Returns a token for a resync. The token after it is free for a second resync request."""
        return self.probes.next_token()

    @property
    def spare_token(self) -> int:
        """The token for a second resync request after the last token."""
        return self.probes.token + 1

    def resyncs_elsewhere(self) -> None:
        """Notes that resyncs have other spans from now on. Their replies are told apart from those
        to earlier resyncs no longer, so that the line settles after the first reply."""
        self.probes.begin_tokens()

    def outstanding_requests(self, since: float) -> int:
        """Counts the requests sent after `since` that have no reply."""
        return sum(sent > since for sent in self.unanswered.sent)

    @property
    def reason(self) -> Reason:
        """The reason of its bad values."""
        return Reason.GARBLED if isinstance(self.trouble, Garbled) else Reason.NO_REPLY

    @property
    def _slow(self) -> bool:
        trouble = self.trouble
        return isinstance(trouble, Garbled) and trouble.evidence is Evidence.SLOW

    def _move(self, event: Event) -> None:
        self.state = TRANSITIONS[self.state, event]
        online = self.state in (State.ONLINE, State.FAILING)
        if online is not self.online:
            self.online = online
            self._presence.note()

    # Frames of a device that only sends unsolicited frames

    def understood(self) -> None:
        """Notes a correct frame."""
        self.trouble = None

    def not_understood(self, damage: Garbled) -> None:
        """Notes bytes that are no frame."""
        self.trouble = damage


def diagnosis(trouble: GatewayError | None, silent_causes: str) -> Diagnosis:
    """Returns the likely cause of the trouble.

    `silent_causes`: causes of no reply that are special to the protocol.
    """
    match trouble:
        case None:
            return NO_TROUBLE
        case Garbled() as error:
            advice = _ADVICE.get(error.evidence, "not understood")
            return Diagnosis(error.evidence.value, f"{advice} ({error})")
        case NoReply():
            return Diagnosis(Evidence.SILENCE.value, f"{_SILENCE} {silent_causes}".strip())
        case error:
            return Diagnosis("other", str(error))


_SILENCE = (
    "No byte came back: check power, wiring (A and B), station number, baud rate and that no "
    "other master is on the line."
)
_ADVICE = {
    Evidence.ECHO: "Only our own request came back: the adapter echoes; set `echo: true`. "
    "The station itself does not reply",
    Evidence.NOISE: "Bytes arrived that are no frame: check baud rate, parity, data bits, and "
    "if A and B are swapped",
    Evidence.CHECKSUM: "Frames arrive with a wrong check sum: noise, missing termination, or sum "
    "check set differently on both sides",
    Evidence.STATION: "Another station replied: check the station numbers",
    Evidence.SHAPE: "The reply belongs to another request, or has another format",
    Evidence.SLOW: "The device replies too late: raise reply_timeout",
    Evidence.REFUSAL: "It refuses with the code of another request: a fault of the device, or "
    "another master is on the line",
    Evidence.TRUNCATED: "Replies break off: noise, or a device server that cuts packets",
}
