"""The telephone calls of a line with a modem: when it dials, and when it hangs up.

Synchronous and pure, like the engine. A line without a modem has no `Calls`.
"""

from dataclasses import dataclass

from gateway.engine.device.device import Device
from gateway.engine.device.health import State
from gateway.engine.device.records import COMPLETE, CallRecord, CallState
from gateway.engine.effects import Effect, LogEvent
from gateway.engine.engine import Engine
from gateway.engine.jobs.poll_entry import PollEntry
from gateway.errors import CallEnded, LineDown

NEVER = float("inf")


@dataclass(frozen=True, slots=True, kw_only=True)
class CallRules:
    """Times in seconds."""

    tries: float = 3  # failed calls in a row until the values turn bad
    retry_pause: float = 10.0  # between two calls
    idle: float = 5.0  # without an exchange, until the call is ended
    rounds: bool = False  # the calls are connections: there is no telephone
    early: float = 0.0  # from the call to the first request


class DialSchedule:
    """The rules of the calls of one line.

    * A poll that is due, a request and a read on demand dial. A call reads all blocks that are due
      within half their interval.
    * A device that is not online dials at its shortest interval, not at that of its probes.
    * A call ends after `idle` seconds without an exchange, unless a poll is due so soon again.
    * After a failed call the line dials again, `tries` calls in all. Then all values turn bad, all
      waiting requests end, and the line dials again at the next interval, or for a request.
    * A call that breaks off in the middle of its work is a failed one, and a lost port for the
      values and requests.
    * Each call begins with a resync of every device: another station may have taken the call.
    * A connection (`rounds`) needs no resync, and may end whenever no poll is due.
    """

    def __init__(self, engine: Engine, rules: CallRules) -> None:
        self.failed = 0  # calls in a row
        self.record = CallRecord() if rules.rounds else engine.record.telephone()
        engine.reach_by_modem()
        self._engine = engine
        self._rules = rules
        self._ended = -NEVER  # the last call, or the last try of a call
        self._not_before = -NEVER
        self._active = 0.0  # the last exchange
        self._exchanges = 0  # until then

    # Between calls

    def due(self, now: float) -> float:
        """Returns the time to dial."""
        wanted = now if self.failed or self._is_wanted else self._next_interval()
        return max(wanted - self._rules.early, self._not_before)

    @property
    def _is_wanted(self) -> bool:
        schedule = self._engine.schedule
        return bool(schedule.requests.waiting) or schedule.is_expedited

    def _next_interval(self) -> float:
        devices = self._engine.devices
        return min((due for device in devices if (due := self._due(device)) < NEVER), default=NEVER)

    def _due(self, device: Device) -> float:
        polls = self._engine.schedule.polls(device)
        if device.health.online:
            return min(map(_due, polls), default=NEVER)
        return min((self._ended + poll.block.every for poll in polls), default=NEVER)

    def dial(self, now: float) -> None:
        """Begins a try of a call."""
        self.record.enter(CallState.DIALLING, now)

    def connect(self, now: float) -> list[Effect]:
        """Begins a call."""
        self.record.connect(now)
        self._active, self._exchanges = now, self._count()
        engine = self._engine
        effects = [] if engine.is_open else engine.opened(now)
        for device in engine.devices:
            if not self._rules.rounds:
                device.health.reconnected()
            if device.identity is not None:
                device.identity.doubt(now)
            device.monitor.forget()
        engine.schedule.take_along(now)
        return effects

    # In a call

    def over(self, now: float) -> float:
        """Returns the time to hang up, while the engine is idle; NEVER: it has work to do."""
        count = self._count()
        if count != self._exchanges:
            self._active, self._exchanges = now, count
        ended = self._active + self._rules.idle
        if ended > now:
            return ended
        return NEVER if self._is_busy(now + self._rules.idle) else now

    def _is_busy(self, until: float) -> bool:
        if self._is_wanted:
            return True
        unknown = (State.STARTING, State.FAILING)
        for device in self._engine.devices:
            health, polls = device.health, self._engine.schedule.polls(device)
            if health.answerable and polls and health.state in unknown:
                return True
            if health.online and min(map(_due, polls), default=NEVER) <= until:
                return True
        return False

    def _count(self) -> int:
        records = (device.record for device in self._engine.devices)
        return sum(record.exchanges + record.writes + record.heard for record in records)

    # The end of a call

    def end(
        self, why: CallEnded | None, now: float, time: int, *, working: bool = False
    ) -> list[Effect]:
        """Ends a call, or a try of one. `why` None: it is complete, and we hung up.

        `working`: it broke off during a transaction.
        """
        was_connected = self.record.state is CallState.CONNECTED
        working = working and not self._rules.rounds
        self.record.enter(CallState.IDLE, now)
        self._ended, self._not_before = now, now + self._rules.retry_pause
        if why is None or (was_connected and not working and not self._is_busy(now)):
            self.record.count(COMPLETE)
            self.failed = 0
            self._not_before = now
            return []
        self.failed += 1
        self.record.fail(str(why), why.result)
        if self.failed < self._rules.tries:
            return self._lost(why, now, time) if was_connected else []
        more = f" ({self.failed} calls in a row failed)" if self.failed > 1 else ""
        self.failed = 0
        return self._lost(LineDown(f"{why}{more}"), now, time)

    def _lost(self, why: LineDown, now: float, time: int) -> list[Effect]:
        fields: dict[str, object] = {"line": self._engine.name, "why": str(why)}
        event = LogEvent("warning", "line down", fields)
        return [*self._engine.lost(why, now, time), event]


def _due(poll: PollEntry) -> float:
    """Returns the time of the next call for the poll. A block that cannot be read waits its turn:
    the schedule would try it again every minute."""
    if poll.reads.at is None and poll.asked:
        return max(poll.due, poll.asked + poll.block.every)
    return poll.due
