"""An engine driven by hand: no event loop, no port. Times in seconds of its own clock."""

from collections.abc import Sequence
from dataclasses import replace
from math import inf
from pathlib import Path

from gateway.config import load
from gateway.engine.device.device import Device
from gateway.engine.device.health import State
from gateway.engine.effects import Effect, LogEvent, OnlineChange, Pause, RequestEnded, Samples
from gateway.engine.engine import Engine
from gateway.engine.jobs.jobs import (
    Idle,
    Job,
    Poll,
    Probe,
    Reopen,
    Result,
    Resynced,
    Settle,
    Settled,
    Traffic,
    Transacted,
)
from gateway.engine.jobs.poll_entry import PollEntry
from gateway.engine.jobs.requests import Command, Outcome, Request, Write
from gateway.errors import DeviceError, LineDown, NoReply
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.modbus import ModbusRtu, ModbusTcp
from gateway.tags import Quality, Sample, WriteResult, WriteRule
from gateway.values import Value
from tests.sim.bench import WIRE
from tests.sim.plant import made_device, make_tag

EXAMPLES = Path(__file__).parents[2] / "examples"
SECOND = 1_000_000_000
REPLIED = Traffic(sent=17, heard=20, exchanges=1, turnaround=0.005)
UNANSWERED = Traffic(sent=17)
SILENCE = NoReply("no reply")
LOST = LineDown("unplugged")
RULES = {
    "D0": WriteRule(),
    "D1": WriteRule(),
    "D2": WriteRule(verify=True),
    "D3": WriteRule(repeat=True),
    "D4": WriteRule(verify=True, repeat=True),
    "D5": WriteRule(latest=True),
}


def link_device(*, retries: int = 1, station: int = 1) -> Device:
    """A PLC with one block of six words, one for each rule; it takes commands."""
    driver = ComputerLink(station=station, monitor=False)
    timing = replace(driver.timing, reply_timeout=0.5, retries=retries)
    tags = [make_tag(text, driver, write=rule) for text, rule in RULES.items()]
    return made_device(f"plc{station}", driver, WIRE, timing, tags, control=True)


def broadcast_device() -> Device:
    """Writes to all stations of a Modbus line; none of them replies."""
    driver = ModbusRtu(station=0)
    timing = replace(driver.timing, retries=1)
    tags = [make_tag("holding:1", driver, write=WriteRule())]
    return made_device("all", driver, WIRE, timing, tags)


def bit_device() -> Device:
    """Bit 3 and bit 4 of one register, and the register beside it."""
    driver = ModbusRtu(station=1)
    texts = ("holding:7.3", "holding:7.4", "holding:8")
    tags = [make_tag(text, driver, write=WriteRule()) for text in texts]
    return made_device("bits", driver, WIRE, replace(driver.timing, retries=1), tags)


def tcp_device(blocks: int = 6, *, retries: int = 1) -> Device:
    """Takes several requests at once; has so many blocks of one register."""
    driver = ModbusTcp(station=1, window=4)
    tags = [
        make_tag(f"holding:{1000 * n}", driver, write=WriteRule()) for n in range(1, blocks + 1)
    ]
    return made_device("tcp", driver, WIRE, replace(driver.timing, retries=retries), tags)


def weighing_machine() -> Device:
    """Sends its weight unsolicited and expects a reply."""
    [line] = load(EXAMPLES / "weighing-machine.yaml").lines
    [settings] = line.devices
    return Device(settings, line.wire)


class Rig:
    """One engine with an open line, and its effects so far."""

    def __init__(self, *devices: Device) -> None:
        self.devices = devices or (link_device(),)
        self.device = self.devices[0]
        self.engine = Engine("line", self.devices, WIRE)
        self.now = 0.0
        self.samples: list[Sample] = []
        self.outcomes: dict[Request, Outcome] = {}
        self.logged: list[LogEvent] = []
        self.note(self.engine.opened(0.0))

    @property
    def time(self) -> int:
        return int(self.now * SECOND)

    def note(self, effects: Sequence[Effect]) -> Sequence[Effect]:
        for effect in effects:
            match effect:
                case Samples(samples):
                    self.samples += samples
                case RequestEnded(request, outcome):
                    assert request not in self.outcomes, "a request has one outcome"
                    self.outcomes[request] = outcome
                case LogEvent():
                    self.logged.append(effect)
        return effects

    def next(self) -> Job:
        return self.engine.next(self.now)

    def transacted(self) -> Transacted:
        """The next job that is not `Idle`, at its time."""
        job = self.next()
        while isinstance(job, Idle) and self.now < job.until < inf:
            self.now = job.until
            job = self.next()
        assert not isinstance(job, Idle | Reopen)
        return job

    def entry(self, poll: Poll) -> PollEntry:
        """The entry of a poll in the schedule."""
        return next(e for e in self.engine.schedule.polls(poll.device) if e.job is poll)

    def conclude(
        self, job: Transacted, result: Result, traffic: Traffic | None = None, took: float = 0.02
    ) -> Sequence[Effect]:
        self.now += took
        known = UNANSWERED if isinstance(result, Exception | Settled) else REPLIED
        traffic = known if traffic is None else traffic
        return self.note(self.engine.conclude(job, result, traffic, self.now, self.time))

    def fail(
        self, job: Transacted, late: float | None = None, error: DeviceError = SILENCE
    ) -> None:
        """No reply within the time-out; `late` seconds after it the reply, if at all."""
        self.conclude(job, error, took=0.5)
        settle = self.next()
        assert isinstance(settle, Settle)
        self.conclude(settle, Settled(late), took=0.1)

    # States

    def bring(self, state: State) -> None:
        """Brings the device there. A failing one needs no resync: its late reply arrived."""
        if state is State.STARTING:
            return
        probe = self.next()
        assert isinstance(probe, Probe)
        if state is State.OFFLINE:
            self.fail(probe)
            if probe.timeout is not None:  # a short one
                self.fail(self.transacted())
        else:
            self.conclude(probe, Resynced(1))
        if state is State.FAILING:
            poll = self.next()
            assert isinstance(poll, Poll)
            self.fail(poll, late=0.1)
        assert self.device.state is state

    # Requests

    def write(self, text: str, value: Value = 7) -> Write:
        tag = next(tag for tag in self.device.tags if tag.text == text)
        write = Write(self.device, tag, tag.encode(value), self.now)
        self.note(self.engine.submit(write, self.now))
        return write

    def command(self, name: str = "stop", argument: str = "") -> Command:
        command = Command(self.device, name, argument, self.now)
        self.note(self.engine.submit(command, self.now))
        return command


def kinds(effects: Sequence[Effect]) -> str:
    """The effects in words, without log events."""
    return "+".join(word for effect in effects if (word := kind(effect))) or "-"


def kind(effect: Effect) -> str:
    match effect:
        case Samples(samples):
            bad = {str(s.reason) for s in samples if s.quality is Quality.BAD}
            return f"bad:{'+'.join(sorted(bad))}" if bad else "good"
        case OnlineChange(online=online):
            return "online" if online else "offline"
        case RequestEnded(outcome=outcome):
            return ended(outcome)
        case Pause():
            return "pause"
        case LogEvent():
            return ""


def ended(outcome: Outcome) -> str:
    match outcome:
        case WriteResult(verified=True):
            return "verified"
        case WriteResult(acknowledged=False):
            return "sent"
        case WriteResult():
            return "written"
        case str():
            return "obeyed"
        case error:
            return type(error).__name__
