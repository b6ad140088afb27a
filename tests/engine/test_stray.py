"""Stray frames: counted, logged now and then, and the end of a monitor list."""

import pytest

from gateway.engine.device.device import Device
from gateway.engine.effects import Effects, LogEvent
from gateway.engine.results.health_rules import HealthRules
from gateway.engine.results.staleness import Staleness
from gateway.engine.results.stray import LOG_EVERY, PAUSE, Stray
from gateway.engine.schedule.in_flight import InFlight
from gateway.engine.schedule.schedule import Schedule
from gateway.protocols.computer_link.codec import Ack, Text
from gateway.protocols.driver import Span
from gateway.protocols.modbus.frame import Frame
from gateway.protocols.modbus.mbap import MbapCodec
from gateway.stations.computer_link import ComputerLinkStation
from tests.engine.rig import link_device, tcp_device
from tests.sim.plant import device, words

LIST = (Span("D", 0, 1),)
ON_DEMAND = ComputerLinkStation(1).on_demand("1E61")


class StrayLine:
    """The stray frames of one line."""

    def __init__(self, *devices: Device) -> None:
        self.effects = Effects()
        schedule = Schedule(devices, 0.0)
        staleness = Staleness(schedule, self.effects)
        results = HealthRules("line", schedule, InFlight(), staleness, self.effects)
        self.stray = Stray("line", devices, results, self.effects)
        for one in devices:
            one.monitor.must_register(LIST)

    def log(self) -> list[LogEvent]:
        return [effect for effect in self.effects.take() if isinstance(effect, LogEvent)]


def test_a_stray_frame_of_the_station_is_counted_and_explained() -> None:
    dev = link_device()
    line = StrayLine(dev)
    line.stray.received(ON_DEMAND, 0.0, 0)
    fields: dict[str, object] = {
        "line": "line",
        "device": "plc1",
        "what": "on-demand data of station 1: 1E61",
        "count": 1,
    }
    assert line.log() == [LogEvent("info", "stray frame", fields)]
    assert dev.record.unasked == 1


def test_a_stray_frame_of_another_station_is_neither_counted_nor_logged() -> None:
    dev, other = link_device(station=1), link_device(station=2)
    line = StrayLine(dev, other)
    line.stray.received(ON_DEMAND, 0.0, 0)
    assert [event.fields["device"] for event in line.log()] == ["plc1"]
    assert (dev.record.unasked, other.record.unasked) == (1, 0)


@pytest.mark.parametrize(
    ("pdu", "alone", "due"),
    [
        (b"\x83\x0b", False, 33.0),
        (b"\x83\x0a", False, 33.0),
        (b"\x83\x02", False, 3.0),
        (b"\x83\x0b", True, 3.0),
    ],
)
def test_a_late_answer_of_a_gateway_says_if_the_station_is_there(
    pdu: bytes, alone: bool, due: float
) -> None:
    dev = tcp_device()
    line = StrayLine(dev) if alone else StrayLine(dev, link_device())
    dev.health.gave_up(0.0, 1.0)
    dev.health.left_outstanding(None, 0.0)
    line.stray.received(MbapCodec().encode(Frame(1, pdu, 7)), 3.0, 0)
    assert dev.health.probes.due == due


def test_any_stray_byte_forgets_every_monitor_list() -> None:
    devices = link_device(station=1), link_device(station=2), device(words(0, 1), station=3)
    StrayLine(*devices).stray.received(b"\x00", 0.0, 0)
    assert [one.monitor.registered for one in devices] == [(), (), ()]


def test_a_frame_may_arrive_in_pieces_with_short_pauses() -> None:
    line = StrayLine(link_device())
    for n, byte in enumerate(ON_DEMAND):
        line.stray.received(bytes([byte]), n * PAUSE / 2, 0)
    assert len(line.log()) == 1


def test_after_a_pause_a_new_frame_begins() -> None:
    line = StrayLine(link_device())
    line.stray.received(ON_DEMAND[:5], 0.0, 0)
    line.stray.received(ON_DEMAND, 1.1 * PAUSE, 0)
    assert len(line.log()) == 1
    line.stray.received(ON_DEMAND[:5], 20.0, 0)
    line.stray.received(ON_DEMAND[5:], 20.0 + 1.1 * PAUSE, 0)
    assert line.log() == []


@pytest.mark.parametrize("damage", [b"\x0201FE12\x0300", b"\x0201FF1E61\x0300"])
def test_a_damaged_frame_is_skipped_and_the_next_is_read(damage: bytes) -> None:
    line = StrayLine(link_device())
    line.stray.received(damage, 0.0, 0)
    assert line.log() == []
    line.stray.received(ON_DEMAND, 1.0, 0)
    assert len(line.log()) == 1


def test_frames_are_logged_as_information_only_now_and_then() -> None:
    line = StrayLine(link_device())
    levels = list[str]()
    for now in (0.0, 0.5 * LOG_EVERY, LOG_EVERY - 0.01, LOG_EVERY, 1.5 * LOG_EVERY):
        line.stray.received(ON_DEMAND, now, 0)
        levels += [event.level for event in line.log()]
    assert levels == ["info", "debug", "debug", "info", "debug"]


def test_each_device_has_its_own_log_interval() -> None:
    dev, other = link_device(station=1), link_device(station=2)
    line = StrayLine(dev, other)
    line.stray.unmatched(dev, Text(1, "7", "FE"), 0.0, 0, echo=False)
    line.stray.unmatched(other, Text(2, "7", "FE"), 0.1, 0, echo=False)
    assert [event.level for event in line.log()] == ["info", "info"]


def test_a_frame_within_a_transaction_forgets_the_list_of_its_device_alone() -> None:
    dev, other = link_device(station=1), link_device(station=2)
    line = StrayLine(dev, other)
    line.stray.unmatched(dev, Ack(1), 0.0, 0, echo=False)
    assert (dev.monitor.registered, other.monitor.registered) == ((), LIST)
    assert line.log() == []  # the driver has no explanation
    assert (dev.record.unasked, other.record.unasked) == (1, 0)


def test_a_protocol_without_stray_frames_explains_nothing() -> None:
    dev = device(words(0, 1))
    line = StrayLine(dev)
    line.stray.received(ON_DEMAND, 0.0, 0)
    line.stray.unmatched(dev, object(), 0.0, 0, echo=False)
    assert line.log() == []
    assert dev.record.unasked == 1
