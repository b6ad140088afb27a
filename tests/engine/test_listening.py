"""A listen-only line: what it learns, when a value is too old, and that it has no job."""

import math

from gateway.engine.device.device import Device
from gateway.engine.device.device_settings import DeviceSettings
from gateway.engine.device.health import State
from gateway.engine.effects import Effect, OnlineChange, RequestEnded, Samples
from gateway.engine.engine import Engine
from gateway.engine.jobs.jobs import Idle
from gateway.engine.jobs.requests import Command, Write
from gateway.errors import BadValue
from gateway.planning.wire_timing import WireTiming
from gateway.protocols.checksums import crc16
from gateway.protocols.driver import Address, Span, Unit
from gateway.protocols.modbus import ModbusRtu
from gateway.tags import Reason, Sample, Tag, WriteRule
from gateway.values import Layout, parse_type

WIRE = WireTiming(9600, 10)


def rtu(*body: int) -> bytes:
    return bytes(body) + crc16(bytes(body))


def tag(name: str, number: int, every: float = 1.0) -> Tag:
    return Tag(
        device="meter",
        name=name,
        text=f"holding:{number}",
        address=Address("holding", number),
        span=Span("holding", number, 1),
        unit_kind=Unit.WORD,
        layout=Layout(parse_type("uint16")),
        every=every,
        write=WriteRule(),
    )


POWER, FLOW, SLOW = tag("power", 0), tag("flow", 3), tag("slow", 9, every=60.0)
READ, REPLY = rtu(1, 3, 0, 0, 0, 4), rtu(1, 3, 8, 0, 7, 0, 0, 0, 0, 0, 8)


class Heard:
    """An engine that listens, and what it says. Times in seconds."""

    def __init__(self) -> None:
        driver = ModbusRtu(station=1)
        settings = DeviceSettings(
            name="meter",
            driver=driver,
            timing=driver.timing,
            control=True,
            listen_only=True,
            tags=(POWER, FLOW, SLOW),
        )
        self.device = Device(settings, WIRE)
        self.engine = Engine("hall", [self.device], WIRE)
        self.effects: list[Effect] = self.engine.opened(0.0)

    def hear(self, at: float, *frames: bytes) -> list[Sample]:
        """Returns the samples until then. The frames follow each other after 10 ms."""
        self.until(at)
        for number, frame in enumerate(frames):
            now = at + 0.01 * number
            self.effects += self.engine.received(frame, now, round(now * 1e9))
        return self.samples()

    def until(self, at: float) -> list[Sample]:
        while (due := self.engine.deadline) <= at:
            self.effects += self.engine.expire(due, round(due * 1e9))
        return self.samples()

    def samples(self) -> list[Sample]:
        found = [one for effect in self.effects if isinstance(effect, Samples) for one in effect[0]]
        self.effects = [one for one in self.effects if not isinstance(one, Samples)]
        return found


def test_the_tags_inside_a_read_of_the_other_master_are_learned() -> None:
    heard = Heard()
    first = heard.hear(1.0, READ, REPLY)
    assert [(one.tag, one.value, one.time) for one in first] == [
        (POWER, 7, 1_010_000_000),
        (FLOW, 8, 1_010_000_000),
    ]
    assert OnlineChange(heard.device, True) in heard.effects
    assert heard.hear(2.0, READ, rtu(1, 0x83, 2)) == []
    assert heard.hear(2.5, rtu(1, 6, 0, 0, 0, 99), rtu(1, 6, 0, 0, 0, 99)) == []


def test_a_value_that_is_not_heard_any_more_turns_overdue() -> None:
    heard = Heard()
    heard.hear(1.0, READ, REPLY)
    assert heard.hear(3.0, READ, REPLY)
    assert heard.until(6.0) == []
    old = heard.until(6.02)
    assert [(one.tag, one.reason) for one in old] == [
        (POWER, Reason.OVERDUE),
        (FLOW, Reason.OVERDUE),
    ]
    assert "does the other master read it?" in old[0].detail
    assert OnlineChange(heard.device, False) not in heard.effects
    assert [one.tag for one in heard.until(180.1)] == [SLOW]  # never heard at all
    assert OnlineChange(heard.device, False) in heard.effects
    assert heard.device.state is State.OFFLINE
    assert heard.device.diagnosis() == "not heard for 180 s: does the other master read it?"
    assert len(heard.hear(200.0, READ, REPLY)) == 2
    assert (heard.device.state, heard.device.diagnosis()) == (State.ONLINE, "")


def test_a_second_reply_turns_the_values_of_the_first_one_bad() -> None:
    heard = Heard()
    assert len(heard.hear(1.0, READ, REPLY)) == 2
    extra = heard.hear(1.05, REPLY)
    assert [(one.tag, one.reason) for one in extra] == [
        (POWER, Reason.GARBLED),
        (FLOW, Reason.GARBLED),
    ]
    assert heard.hear(1.5, READ, REPLY) == []


def test_a_listen_only_line_has_no_job_whatever_is_asked_of_it() -> None:
    heard = Heard()
    engine, device = heard.engine, heard.device
    heard.hear(1.0, READ, REPLY)
    engine.expedite(device, POWER)
    assert engine.next(1.1) == Idle(math.inf)
    for request in (Write(device, POWER, [1], 1.1, 5.0), Command(device, "run", "", 1.1, 5.0)):
        [ended] = engine.submit(request, 1.2)
        assert isinstance(ended, RequestEnded)
        assert isinstance(ended.outcome, BadValue)
        assert str(ended.outcome) == "line hall is listen-only: the gateway sends nothing on it"
        assert engine.next(1.3) == Idle(math.inf)
    heard.until(1000.0)  # the device is offline now
    assert engine.next(1000.0) == Idle(math.inf)
