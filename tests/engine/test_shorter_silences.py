"""The silence before polls is shortened in steps, and never risks more than one repeated poll."""

from collections.abc import Sequence
from itertools import pairwise

import pytest

from gateway.engine.device.device import Device
from gateway.engine.device.health import State
from gateway.engine.device.station_silence import FORGOTTEN_AFTER
from gateway.engine.jobs.jobs import Idle, Poll, Probe, Resynced, Sent, Settle, Settled, Traffic
from gateway.engine.jobs.requests import Write
from gateway.engine.results.shorter_silences import HELD, PAUSE, PROOF
from gateway.errors import Refusal, Refused
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.driver import AnyDriver
from gateway.protocols.modbus import ModbusAscii, ModbusRtu
from gateway.protocols.vigor import Vigor
from gateway.tags import WriteRule
from tests.engine.rig import SILENCE, Rig
from tests.sim.bench import WIRE
from tests.sim.plant import made_device, make_tag

SAFE, LEAST = 0.005, WIRE.character


def station(number: int = 1, size: int = 2, every: float = 0.02) -> Device:
    """Makes a Vigor PLC with two blocks of so many words; alone it needs more than the wire."""
    driver = Vigor(station=number)
    numbers = [first + n for first in (0, 500) for n in range(size)]
    tags = [make_tag(f"D{n}", driver, type="uint16", every=every) for n in numbers]
    tags.append(make_tag("D900", driver, every=3600.0, write=WriteRule()))
    return made_device(f"plc{number}", driver, WIRE, driver.timing, tags)


class Bus:
    """A line on which stations lose requests that come too early."""

    def __init__(self, *devices: Device, took: float = 0.02) -> None:
        self.rig = Rig(*devices)
        self.took = took  # seconds of a transaction
        self.listens_after: dict[Device, float] = {}  # seconds after any reply
        self.drives_for: dict[Device, float] = {}  # seconds after its own reply
        self.off: set[Device] = set()
        self.kept: list[tuple[object, float]] = []  # jobs, and the silences before them
        self.losses: list[float] = []  # times
        self._spoke: Device | None = None

    @property
    def shortest(self) -> float:
        return min(device.silence.shorter for device in self.rig.devices)

    def step(self) -> object:
        """Performs one job, all stations of the bus replying as soon as they can."""
        rig = self.rig
        job = rig.next()
        match job:
            case Idle(until=until):
                rig.now = until
                self._spoke = None
                return job
            case Settle():
                rig.conclude(job, Settled(None))
                return job
        device = job.device  # type: ignore[union-attr]  # the line is not opened again
        kept = device.silence.kept
        self.kept.append((job, kept))
        needed = self.listens_after.get(device, 0.0)
        if self._spoke is not None:
            needed = max(needed, self.drives_for.get(self._spoke, 0.0))
        if device in self.off or (self._spoke is not None and kept < needed):
            if device not in self.off:
                self.losses.append(rig.now)
            rig.conclude(job, SILENCE, Traffic(sent=17, silence=kept), took=0.5)  # type: ignore[arg-type]
            self._spoke = None
            return job
        replied = Traffic(17, 20, 1, 0.005, silence=kept)
        match job:
            case Probe():
                rig.conclude(job, Resynced(1000), replied, self.took)
            case Poll():
                rig.conclude(job, [7] * job.span.size, replied, self.took)
            case Write():
                rig.conclude(job, Sent(), replied, self.took)
        self._spoke = device
        return job

    def run(self, polls: int) -> None:
        left = polls
        while left:
            left -= isinstance(self.step(), Poll)

    def jump(self, seconds: float) -> None:
        """Lets the time pass without a request."""
        self.rig.now += seconds
        self._spoke = None

    def learn(self) -> None:
        """Runs until the last step."""
        self.run(6 * PROOF * len(self.rig.devices) + 10)


def test_silences_are_halved_in_steps_while_no_reply_is_lost() -> None:
    bus = Bus(station())
    seen = []
    for _ in range(6 * PROOF):
        bus.run(1)
        if bus.shortest not in seen:
            seen.append(bus.shortest)
    assert seen == [SAFE, SAFE / 2, SAFE / 4, SAFE / 8, LEAST]
    shortened = [n for n, (_, kept) in enumerate(bus.kept) if kept < SAFE]
    assert shortened[0] > PROOF


@pytest.mark.parametrize("by", ["listens_after", "drives_for"])
def test_a_silence_that_was_too_short_is_tried_again_after_1_3_7_and_15_hours(by: str) -> None:
    bus = Bus(station())
    getattr(bus, by)[bus.rig.device] = 0.002
    for _ in range(8 * 60):
        bus.run(11)
        bus.jump(60.0)
    hours = [round((at - bus.losses[0]) / FORGOTTEN_AFTER) for at in bus.losses]
    assert 3 <= len(hours) <= 4
    assert all(n >= 2**k - 1 for k, n in enumerate(hours))
    assert bus.shortest in (SAFE, SAFE / 2)


def test_a_lost_poll_brings_all_safe_silences_back_for_a_minute_at_least() -> None:
    bus = Bus(station(1, every=0.04), station(2, every=0.04), station(3, every=0.04))
    bus.learn()
    assert bus.shortest == LEAST
    third = bus.rig.devices[2]
    bus.listens_after[third] = 0.001
    while not bus.losses:
        bus.step()
    lost = len(bus.kept)
    bus.run(PROOF)
    bus.jump(PAUSE - 10.0)
    bus.run(PROOF)
    assert {kept for _, kept in bus.kept[lost:]} == {SAFE}
    assert third.state is State.ONLINE
    bus.jump(PAUSE)
    bus.learn()
    bus.learn()
    assert len(bus.losses) == 1
    assert bus.shortest == LEAST  # others learn again
    assert third.silence.shorter == pytest.approx(2 * LEAST)


def test_the_station_that_replied_just_before_needs_its_silence_too() -> None:
    bus = Bus(station(1, every=0.04), station(2, every=0.04), station(3, every=0.04))
    first = bus.rig.device
    bus.drives_for[first] = 0.003
    bus.learn()
    assert len(bus.losses) == 1
    bus.jump(1.5 * FORGOTTEN_AFTER)
    bus.learn()
    assert len(bus.losses) == 1
    assert first.silence.shorter == SAFE
    after = {
        (before.device, job.device): kept
        for (before, _), (job, kept) in pairwise(bus.kept[-200:])
        if isinstance(before, Poll) and isinstance(job, Poll)
    }
    assert {kept for (before, _), kept in after.items() if before is first} == {SAFE}
    assert min(after.values()) < SAFE


def test_a_write_a_probe_and_what_follows_them_keep_the_safe_silence() -> None:
    bus = Bus(station())
    bus.learn()
    tag = bus.rig.device.tags[-1]
    for _ in range(20):
        write = Write(bus.rig.device, tag, tag.encode(7), bus.rig.now)
        bus.rig.note(bus.rig.engine.submit(write, bus.rig.now))
        bus.run(3)
    bus.off.add(bus.rig.device)
    bus.run(1)
    bus.off.clear()
    bus.run(3)
    since = bus.kept[6 * PROOF :]
    assert min(kept for job, kept in since if isinstance(job, Poll)) == LEAST
    assert {kept for job, kept in since if not isinstance(job, Poll)} == {SAFE}
    jobs = [(before, kept) for (before, _), (_, kept) in pairwise(since)]
    assert {kept for before, kept in jobs if not isinstance(before, Poll)} == {SAFE}


def test_a_repeated_poll_keeps_the_safe_silence() -> None:
    bus = Bus(station())
    bus.learn()
    first = bus.rig.transacted()
    assert isinstance(first, Poll)
    refused = Refused("busy", code="06", refusal=Refusal.BUSY)
    bus.rig.conclude(first, refused, Traffic(17, 12, 1, 0.005, silence=LEAST))
    since = len(bus.kept)
    bus.run(40)
    kept = [
        kept for job, kept in bus.kept[since:] if isinstance(job, Poll) and job.block is first.block
    ]
    assert kept[0] == SAFE
    assert min(kept) < SAFE


def test_a_refusal_because_of_damage_brings_the_safe_silences_back() -> None:
    bus = Bus(station())
    bus.learn()
    refused = Refused("sum check error", code="11", refusal=Refusal.DAMAGED)
    traffic = Traffic(17, 12, 1, 0.005, silence=LEAST)
    bus.rig.conclude(bus.rig.transacted(), refused, traffic)
    since = len(bus.kept)
    bus.run(PROOF)
    assert {kept for _, kept in bus.kept[since:]} == {SAFE}


def test_a_poll_whose_reply_could_be_a_copy_of_the_last_one_keeps_the_safe_silence() -> None:
    """Full blocks cannot be read with an address more, so that their replies differ."""
    bus = Bus(station(size=64))
    bus.learn()
    full = [kept for job, kept in bus.kept if isinstance(job, Poll) and job.span.size == 64]
    assert set(full) == {SAFE}


def test_a_device_that_goes_offline_was_not_asked_too_early() -> None:
    bus = Bus(station(1), station(2, every=3600.0))
    bus.learn()
    first = bus.rig.device
    bus.off.add(first)
    while first.state is not State.OFFLINE:
        bus.step()
    bus.off.clear()
    bus.run(100)
    bus.jump(300.0)
    bus.learn()
    assert first.silence.shorter == LEAST


def test_bytes_that_answer_no_request_bring_the_safe_silences_back() -> None:
    bus = Bus(station())
    bus.learn()
    bus.rig.note(bus.rig.engine.received(b"\x02", bus.rig.now, bus.rig.time))
    bus.run(PROOF)
    assert {kept for _, kept in bus.kept[-PROOF:]} == {SAFE}


def test_the_pause_of_the_line_doubles() -> None:
    bus = Bus(station())
    for minutes in (1, 2, 4):
        bus.learn()
        assert bus.shortest == LEAST
        bus.rig.note(bus.rig.engine.received(b"\x02", bus.rig.now, bus.rig.time))
        bus.run(1)
        bus.jump(0.8 * minutes * PAUSE)
        bus.learn()
        assert bus.shortest == SAFE
        bus.jump(0.2 * minutes * PAUSE)


def test_a_silence_is_forgotten_only_after_it_was_tried_again() -> None:
    bus = Bus(station())
    bus.listens_after[bus.rig.device] = 0.002
    bus.learn()
    bus.jump(PAUSE)
    bus.run(HELD + 6 * PROOF)
    assert len(bus.losses) == 1
    bus.jump(FORGOTTEN_AFTER)
    bus.run(6 * PROOF)
    assert len(bus.losses) == 2
    bus.jump(1.9 * FORGOTTEN_AFTER)
    bus.run(6 * PROOF)
    assert len(bus.losses) == 2


def test_losses_are_forgotten_after_many_replies() -> None:
    bus = Bus(station())
    device = bus.rig.device
    device.silence.was_too_short(0.0, 0.0)
    device.silence.was_too_short(0.0, 0.0)
    bus.rig.now = 4 * FORGOTTEN_AFTER
    bus.run(HELD + 6 * PROOF)
    now = bus.rig.now
    device.silence.was_too_short(0.002, now)
    device.silence.take_step(4, now + FORGOTTEN_AFTER - 1)
    assert device.silence.shorter == pytest.approx(0.004)
    device.silence.take_step(4, now + FORGOTTEN_AFTER + 1)
    assert device.silence.shorter == LEAST


def test_any_number_of_losses_can_be_counted() -> None:
    device, now = station(), 0.0
    for _ in range(2000):
        device.silence.was_too_short(0.001, now)
    device.silence.take_step(4, 1e9)
    assert device.silence.shorter == pytest.approx(0.002)


def test_a_line_with_time_to_spare_tries_nothing() -> None:
    bus = Bus(station(every=1.0))
    bus.run(5 * PROOF)
    assert {kept for _, kept in bus.kept} == {SAFE}


def _learns(driver: AnyDriver, texts: Sequence[str]) -> bool:
    tags = [make_tag(text, driver) for text in texts]
    return made_device("plc", driver, WIRE, driver.timing, tags).silence.learns


def test_only_where_no_standard_asks_for_it_and_a_sum_protects_the_address() -> None:
    assert _learns(Vigor(station=1), ["D0"])
    assert _learns(ComputerLink(station=1), ["D0"])
    assert not _learns(ComputerLink(station=1, sum_check=False), ["D0"])
    assert not _learns(ModbusRtu(station=1), ["holding:0"])
    assert not _learns(ModbusAscii(station=1), ["holding:0"])
