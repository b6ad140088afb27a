"""Applies the result of a poll to the schedule, the samples and the bad addresses."""

from collections.abc import Sequence
from typing import Any

from gateway.engine.device.changes import Changes
from gateway.engine.device.device import Device
from gateway.engine.device.health import State
from gateway.engine.device.monitor_list import REFUSED_FOR
from gateway.engine.effects import Effects, Samples
from gateway.engine.jobs.jobs import Probe, Settle
from gateway.engine.jobs.poll_entry import PollEntry
from gateway.engine.results.health_rules import HealthRules
from gateway.engine.schedule.replan_budget import ReplanBudget
from gateway.engine.schedule.schedule import Schedule
from gateway.errors import (
    DeviceError,
    Evidence,
    Garbled,
    GatewayError,
    Refusal,
    Refused,
    RefusedOther,
    Unsteady,
    log_fields,
)
from gateway.planning.bad_addresses import DAMAGED, RETRIES, SILENT, within
from gateway.planning.planner import Block, describe
from gateway.tags import Reason

TOGETHER = RETRIES[0] + 1.0  # seconds in which all addresses that return are tried
# They say nothing of addresses.
OF_OTHERS = (Evidence.STATION, Evidence.SHAPE, Evidence.SLOW, Evidence.ECHO)
NOISY_ROUNDS = 4  # rounds without a reply that noise explains
LIST_MISSED = 3  # rounds without a reply to the monitor list alone, until it is given up
BUSY_PAUSE = 0.2  # seconds of pause for a busy device, doubled each time


class PollRules:
    """The rules for results of polls: good, refused, or without a reply."""

    def __init__(self, schedule: Schedule, results: HealthRules, effects: Effects) -> None:
        self._schedule = schedule
        self._results = results
        self._effects = effects
        self._replans = ReplanBudget(schedule)

    def change(self, changes: Changes) -> None:
        """Takes over changed devices: they have a new plan."""
        for device in changes.left:
            self._replans.forget(device)

    def read(self, poll: PollEntry, units: Sequence[int], now: float, time: int) -> None:
        """Applies a good read of a block. One of an old plan counts for nothing: another poll reads
        its tags, and does not know the age of these values."""
        if not poll.live:
            return
        device, block = poll.device, poll.block
        health = device.health
        if health.needs_resync or health.state is not State.ONLINE:
            self._results.answered(device, now, time)
        shapes = device.shapes
        if shapes is not None and shapes.longer.failed and poll.job.span is not block.span:
            shapes.longer.answered(block.span, poll.job.span)
        if not block.listed:
            device.good_reads.note(block.span)
        samples = self._schedule.read(poll, units, now, time)
        self._effects.collected.append(Samples(samples))
        if block.of_fields:
            self._count_garbled(device, units)
        if not device.bad_addresses.clear:
            self._read_beside_bad(device, block, now)
        replans = self._replans
        if now >= replans.next_at:
            replans.look(now)
        if device.record.exchanges >= device.turnaround.look_at and now >= replans.allowed_from:
            self._learn(device, now)

    def _learn(self, device: Device, now: float) -> None:
        """Compares the plan with the measured turnaround; allows lists again in their time."""
        if device.monitor.again <= now:
            self._replans.want(device, now)
        if device.bad_addresses.searching or (found := device.learn_turnaround()) is None:
            return
        self._replans.spent(device.planning_seconds(device.tags), now)
        if found:
            expected = device.turnaround.expected
            self._effects.info("plan updated", device=device.name, turnaround=expected)
            self._schedule.plan(device, now)

    def _read_beside_bad(self, device: Device, block: Block, now: float) -> None:
        """Applies a good read of a device that has bad addresses or split blocks."""
        bad = device.bad_addresses
        returned = bad.read(block)
        if returned:
            self._effects.info("address returned", device=device.name, block=describe(block))
            self._schedule.try_soon(device, now + RETRIES[0])
            # The others may return as well: one plan for all.
            self._replans.want(device, now, TOGETHER if bad.bad else 0.0)
        elif bad.rejoin(now):
            self._replans.want(device, now)
        self._end_search(device, now)

    def _count_garbled(self, device: Device, fields: Sequence[Any]) -> None:
        """Counts the garbled fields of a good frame."""
        for value in fields:
            if isinstance(value, Garbled):
                device.record.count_failure(value)
                self._effects.info("field garbled", device=device.name, **log_fields(value))

    def unsteady(self, poll: PollEntry, error: Unsteady, now: float, time: int) -> None:
        """Applies two different reads of a block, or one without a proof: polls it again, or turns
        its tags bad."""
        shapes = poll.device.shapes
        in_vain = shapes is not None and shapes.proofs.are_in_vain
        if poll.tries < poll.device.timing.retries and not in_vain:
            self._schedule.again(poll)
            return
        poll.device.bad_addresses.replied(poll.block.span)
        self._end_badly(poll, Reason.GARBLED, error, now, time)

    def refused(self, poll: PollEntry, error: Refused, now: float, time: int) -> None:
        """Applies the refusal of a poll: polls again, halves the block, or turns its tags bad."""
        device, block = poll.device, poll.block
        device.record.count_refusal(error)
        if block.listed:
            device.monitor.forget()
        if self._refused_longer(poll, error, now):
            return
        if error.refusal is Refusal.DAMAGED and poll.tries < device.timing.retries:
            self._schedule.again(poll)
            return
        if error.refusal is Refusal.BUSY and poll.tries < device.timing.retries:
            self._schedule.again(poll, now + BUSY_PAUSE * 2**poll.tries)
            return
        if block.listed:
            self._list_refused(poll, error, now)
            return
        lasting = error.refusal in (Refusal.ADDRESS, Refusal.OTHER)
        bad = device.bad_addresses
        if lasting and block.span not in bad.bad and not bad.is_trial(block.span):
            # The address may exist: noise can change a request, or the device may have restarted.
            if error.refusal is Refusal.ADDRESS and poll.reads.ever and not poll.tries:
                self._schedule.again(poll)
                return
            if error.refusal is Refusal.OTHER and poll.tries < device.timing.retries:
                self._schedule.again(poll, now + BUSY_PAUSE * 2**poll.tries)
                return
        if lasting and self._halved(poll, error, error.code, now, time):
            return
        self._end_badly(poll, Reason.REFUSED, error, now, time)
        self._end_search(device, now)

    def _refused_longer(self, poll: PollEntry, error: Refused, now: float) -> bool:
        """Polls the block alone if the refused read was longer than the block."""
        shapes = poll.device.shapes
        if shapes is None:
            return False
        shapes.refused(now)
        if poll.job.span is poll.block.span:
            shapes.longer.refused_alone(poll.block.span, poll.reads.at)
            return False
        if error.refusal in (Refusal.DAMAGED, Refusal.BUSY):
            return False
        shapes.longer.refused(poll.block.span, poll.job.span, now)
        self._schedule.again(poll, counted=False)
        return True

    def _halved(
        self, poll: PollEntry, error: DeviceError, code: str, now: float, time: int
    ) -> bool:
        """Polls the halves of a block that failed for good. False: it is a bad address."""
        device, block = poll.device, poll.block
        if block.of_fields or block.listed:  # any part of it is read by the same request
            return False
        known = block.span in device.bad_addresses.bad
        halves = device.bad_addresses.refused(block, time, code)
        if halves:
            self._schedule.replace(poll, halves, now)
            return True
        log = self._effects.debug if known else self._effects.warning
        log("address refused", device=device.name, block=describe(block), why=str(error))
        return False

    def _list_refused(self, poll: PollEntry, error: Refused, now: float) -> None:
        """Registers the monitor list again, or plans without one."""
        if poll.tries < 1:
            self._schedule.again(poll)
        else:
            self._plan_without_list(poll.device, error, now)

    def _plan_without_list(self, device: Device, error: DeviceError, now: float) -> None:
        """Reads the device without a monitor list for an hour: it may have a bad address."""
        self._effects.warning("monitor list refused", device=device.name, why=str(error))
        device.monitor.refused(now)
        device.bad_addresses.abandon()
        device.plan()
        self._schedule.plan(device, now)
        self._replans.want(device, now, REFUSED_FOR)

    def _end_badly(
        self,
        poll: PollEntry,
        reason: Reason,
        error: GatewayError,
        now: float,
        time: int,
        *,
        answered: bool = True,
    ) -> None:
        """Turns the tags of a block bad, after a reply without values or no reply."""
        poll.forget(now)
        self._effects.bad(poll.block.tags, reason, time, str(error))
        self._schedule.polled(poll, now, answered=answered)

    def _end_search(self, device: Device, now: float) -> None:
        if device.bad_addresses.settle(now):
            device.monitor.allow()  # the bad address in the list may be known now
            self._replans.want(device, now)

    def fell_silent(self, settle: Settle, now: float) -> None:
        """Notes the block before a resync without a reply, after which the device is offline: the
        resync may have read beside it. Noise may have destroyed both replies."""
        device, after = settle.device, settle.after
        fell = settle.before is State.FAILING and device.health.state is State.OFFLINE
        read = after.outstanding if fell and isinstance(after, Probe) else None
        if read is None or device.health.probes.is_alive(now):
            return
        for poll in self._schedule.polls(device):
            if within(poll.block.span, read):  # it may have been read with more addresses
                device.bad_addresses.fell_silent(poll.block)

    def unread(
        self, poll: PollEntry, error: DeviceError, now: float, time: int, *, alone: bool = True
    ) -> None:
        """Applies an unclear poll: polls again, halves the block, or turns its tags bad.

        A block that stays without a reply while the device replies to other requests may hold an
        address about which the device is silent, or be too long for it. `alone`: no other request
        failed beside it.
        """
        device, bad = poll.device, poll.device.bad_addresses
        health, retries = device.health, device.timing.retries
        if health.state is State.OFFLINE:
            replied = health.consecutive_failures <= 1  # to the request before
            if alone and replied and not health.probes.is_alive(now):
                bad.went_silent(poll.block)
            return
        if poll.job.span is not poll.block.span and device.shapes is not None:
            device.shapes.longer.unanswered(poll.block.span, poll.job.span, now)
            self._schedule.again(poll, counted=False)
            return
        suspect, half = bad.is_suspect(poll.block.span), bad.is_half(poll.block)
        known = suspect and not half
        if not known and not poll.missed and poll.tries < (min(1, retries) if half else retries):
            self._schedule.again(poll)
            return
        others_answered = health.consecutive_failures <= 1
        # Noise may destroy several replies in a row to a block that was read before.
        rounds = NOISY_ROUNDS if poll.reads.ever and health.probes.is_alive(now) else 0
        lasting = others_answered and (known or half or poll.missed > rounds)
        of_others = isinstance(error, Garbled) and error.evidence in OF_OTHERS
        code = DAMAGED if isinstance(error, Garbled) else SILENT
        if isinstance(error, RefusedOther):
            code = error.code
        if lasting and poll.block.listed and code == SILENT and poll.missed >= LIST_MISSED:
            self._plan_without_list(poll.device, error, now)
            return
        if lasting and not of_others and self._halved(poll, error, code, now, time):
            return
        self._end_badly(poll, health.reason, error, now, time, answered=False)
        self._end_search(device, now)
