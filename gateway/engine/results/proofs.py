"""Proofs: holds good reads that may be extra replies until a resync shows that each is right."""

from collections.abc import Sequence

from gateway.engine.device.device import Device
from gateway.engine.device.reply_shapes import SHOWN, UNPROVEN
from gateway.engine.jobs.jobs import Probe, Result, Settle, Traffic
from gateway.engine.jobs.poll_entry import PollEntry
from gateway.engine.results.health_rules import HealthRules
from gateway.engine.results.poll_rules import PollRules
from gateway.engine.schedule.in_flight import HeldRead, InFlight
from gateway.engine.schedule.schedule import Schedule
from gateway.errors import Refused, Unsteady
from gateway.protocols.driver import EVERY_REQUEST, PROOF

LONGEST = 0.5  # seconds: then reads get their proof


class Proofs:
    """Holds reads of one device, and has one resync prove them.

    If another reply was taken for that to a read, the own one is outstanding. It arrives before
    that to the resync, as one too many. So one resync proves all reads since the one before. It
    proves nothing where the own reply may never come: see `_may_be_alone`.
    """

    def __init__(
        self, schedule: Schedule, in_flight: InFlight, results: HealthRules, polls: PollRules
    ) -> None:
        self._schedule = schedule
        self._in_flight = in_flight
        self._results = results
        self._polls = polls

    def hold(self, read: HeldRead, traffic: Traffic) -> None:
        """Holds the values of a good read."""
        device, now = read.poll.device, read.now
        self._in_flight.hold(read)
        if traffic.extra:
            self._results.answered_twice(device, now, read.time)
        if _may_be_alone(read.poll, traffic):
            self._in_flight.doubt()
        if not traffic.extra:
            read.poll.reads.replied()
        self._go_on(device, [read], now)

    def refused(self, device: Device, now: float) -> None:
        """Goes on after a read that was refused: its reply ended all outstanding requests."""
        if held := self._in_flight.held:
            self._go_on(device, held, now)

    def _go_on(self, device: Device, outstanding: Sequence[HeldRead], now: float) -> None:
        """Reads another due block of the device, or sends the resync."""
        in_flight, health, shapes = self._in_flight, device.health, device.shapes
        if shapes is None:
            return
        for read in outstanding:
            health.left_outstanding(read.poll.job.span, now)
        token = PROOF if device.may_be_proven(now) else health.next_probe_token()
        last, spans = health.outstanding, device.probe_spans
        is_told = token == PROOF or shapes.of_resync(last, token, spans) is None
        ends = self._schedule.requests.waiting or now - in_flight.begun >= LONGEST
        most = 0 if ends or in_flight.doubted or not is_told else shapes.proofs.most
        held = [read.poll for read in in_flight.held]
        if others := self._schedule.alongside(device, int(len(held) < most), now, held):
            in_flight.follow(others[0])
            return
        shapes.probed(last, token, spans, now)
        in_flight.follow(Probe(device, last, token))

    def probed(self, probe: Probe, result: Result, traffic: Traffic, now: float) -> None:
        """Takes what arrived for a resync: extra replies, or a refusal of its read."""
        if traffic.extra:
            self._in_flight.doubt()
        shapes = probe.device.shapes
        if probe.token == PROOF and isinstance(result, Refused) and shapes is not None:
            shapes.proofs.lacks(now)

    def resynced(self, probe: Probe, told_from: int, now: float, time: int) -> None:
        """Releases the reads that waited for this resync, if no extra reply has arrived.

        The reply to the resync may be another one, too, unless its like exists only once. Then
        the wire must be quiet after it: the own replies would arrive.
        """
        device, in_flight = probe.device, self._in_flight
        if not in_flight.held or (shapes := device.shapes) is None:
            return
        only = probe.again or (told_from == EVERY_REQUEST and probe.token != PROOF)
        if in_flight.doubted or only or now - shapes.wary_at >= SHOWN:
            self.release(now, time)
            return
        guard = device.longest_reply + device.settled_after
        after = in_flight.held[-1].poll.job
        in_flight.follow(Settle(device, guard, device.settled_after, after))

    def release(self, now: float, time: int, *, proven: bool = True) -> None:
        """Ends the reads that waited for a proof, if there are any."""
        held, doubted = self._in_flight.release()
        proven = proven and not doubted
        if held and (shapes := held[0].poll.device.shapes) is not None:
            proven = proven and not shapes.proofs.twins.exist(now)
            shapes.proofs.ended(proven=proven)
        for read in held:
            if proven:
                self._polls.read(*read)
            else:
                self._polls.unsteady(read.poll, Unsteady(UNPROVEN), now, time)


def _may_be_alone(poll: PollEntry, traffic: Traffic) -> bool:
    """Returns True if the reply may be another one, and no own reply may follow it.

    The station was silent about this read shortly before. Or, on a doubtful line, it cannot reply
    so soon, or it replies much sooner otherwise: it may have missed the read, and a copy, or the
    reply to another master, took the place.
    """
    if poll.reads.owed or (traffic.doubtful and poll.device.is_doubtful):
        return True
    return poll.device.is_doubtful and poll.device.is_unusual(traffic.turnaround)
