"""No-protocol devices on a whole line, on virtual time: listening, polls, replies, writes."""

import asyncio
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from structlog.testing import capture_logs

from gateway.config import Config, LineConfig, load
from gateway.engine.device.device import Device
from gateway.engine.device.health import State
from gateway.engine.jobs.jobs import Idle, Job
from gateway.engine.results.request_rules import Differs
from gateway.engine.results.unsolicited import REPLY_WITHIN
from gateway.errors import GatewayError, LineDown, Refused
from gateway.line.line import Line
from gateway.northbound.publishing.republish import Republisher
from gateway.plant.build import line_of
from gateway.plant.plant import Plant
from gateway.stations.vigor import VigorStation
from gateway.tags import Quality, Reason, Sample, Tag, WriteResult, good
from gateway.transport import Port, Receiver
from gateway.values import Value
from tests.northbound.plant import nothing
from tests.sim.virtual import VirtualLoop, on_virtual_time
from tests.vectors import vectors

EXAMPLES = Path(__file__).parents[2] / "examples"
SECOND = 1_000_000_000
BY_ID = {v.id: v for v in vectors("noproto-vb1com", "noproto-k120s", "vigor")}
# The A&D EK-L manual's data format, 9-2: header, sign, digits, unit, CR LF.
STABLE = b"ST,+001234.5  g\r\n"
MOVING = b"US,-000012.0  g\r\n"
OVERLOAD = b"OL,+999999.9  g\r\n"

Reply = Callable[[bytes], bytes]


def now() -> float:
    return asyncio.get_running_loop().time()


@dataclass
class Bench:
    """The far end of the port, byte by byte, and the samples of the line."""

    line: Line = field(init=False)
    replies: Reply = lambda _: b""
    pause: float = 0.01  # seconds until it replies
    echo: bool = False
    sent: list[tuple[float, bytes]] = field(default_factory=list)
    delivered: list[tuple[float, Sample]] = field(default_factory=list)
    onlines: list[bool] = field(default_factory=list)
    receiver: Receiver | None = None

    # The port

    async def open(self, receiver: Receiver) -> Port:
        self.receiver = receiver
        return self

    def write(self, data: bytes) -> None:
        self.sent.append((now(), data))
        if self.echo:
            self._later(0.001, data)
        if reply := self.replies(data):
            self._later(self.pause, reply)

    async def close(self) -> None:
        self.receiver = None

    def say(self, data: bytes) -> None:
        assert self.receiver is not None
        self.receiver.received(data)

    def _later(self, pause: float, data: bytes) -> None:
        asyncio.get_running_loop().call_later(pause, self.say, data)

    # The sample sink

    def samples(self, samples: Sequence[Sample]) -> None:
        self.delivered += [(now(), sample) for sample in samples]

    def online(self, device: Device, online: bool) -> None:
        self.onlines.append(online)

    # For tests

    @property
    def words(self) -> list[bytes]:
        return [data for _, data in self.sent]

    def values(self, name: str) -> list[Value | Reason | None]:
        """All samples of a tag: the values, or the reasons of bad ones."""
        return [s.reason or s.value for _, s in self.delivered if s.tag.name == name]

    def last(self, name: str) -> Value | Reason | None:
        return self.values(name)[-1]

    def tag(self, key: str) -> tuple[Device, Tag]:
        return next((d, t) for d in self.line.engine.devices for t in d.tags if t.name == key)

    async def write_tag(self, name: str, value: Value) -> WriteResult | GatewayError:
        device, tag = self.tag(name)
        try:
            return await self.line.write(device, tag, tag.encode(value))
        except GatewayError as error:
            return error


def made_line(config: LineConfig, bench: Bench) -> Line:
    wall = lambda: int(now() * SECOND)  # noqa: E731
    return line_of(config, config.devices, bench, open_port=bench.open, wall=wall)


@asynccontextmanager
async def running(config: Config, number: int = 0, **how: Any) -> AsyncIterator[Bench]:
    """One line of the file, open and served. It must neither end nor fail."""
    bench = Bench(**how)
    line = replace(config.lines[number], echo=bench.echo)
    bench.line = made_line(line, bench)
    task = asyncio.create_task(bench.line.run())
    await asyncio.sleep(0.1)
    yield bench
    assert bench.line.engine.is_open, bench.line.engine.record.trouble
    assert bench.line.engine.record.opened == 1
    assert not task.done()
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


def example(name: str) -> Config:
    return load(EXAMPLES / f"{name}.yaml")


# Unsolicited frames


@on_virtual_time
async def test_a_scale_streams_and_is_never_sent_a_request() -> None:
    async with running(example("scale")) as bench:
        (device,) = bench.line.engine.devices
        assert bench.onlines == []
        for _ in range(20):
            bench.say(MOVING)
            await asyncio.sleep(0.2)
            bench.say(STABLE)
            await asyncio.sleep(0.2)
        assert bench.values("weight")[-2:] == [-12.0, 1234.5]
        assert bench.last("state") == "ST"
        assert bench.onlines == [True]
        assert device.state is State.ONLINE
        assert device.record.heard == 40
        assert bench.sent == []


@on_virtual_time
async def test_a_scale_that_stops_sending_turns_stale_and_offline_until_its_next_frame() -> None:
    async with running(example("scale")) as bench:
        bench.say(STABLE * 2)
        spoke = now()
        await asyncio.sleep(10)
        stale = [(at, s.reason) for at, s in bench.delivered if s.quality is Quality.BAD]
        assert [reason for _, reason in stale] == [Reason.NO_REPLY] * 2  # its two tags, once
        assert stale[0][0] - spoke == pytest.approx(2.0, abs=0.01)
        assert bench.onlines == [True, False]
        bench.say(MOVING)
        assert bench.last("weight") == -12.0
        assert bench.onlines == [True, False, True]
        assert bench.sent == []  # it is never probed


@on_virtual_time
async def test_a_garbled_frame_makes_all_listened_fields_bad_until_the_next_frame() -> None:
    with capture_logs() as logs:
        async with running(example("scale")) as bench:
            (device,) = bench.line.engine.devices
            bench.say(STABLE * 2)
            bench.say(OVERLOAD * 3)
            assert bench.last("weight") is Reason.GARBLED
            assert bench.last("state") is Reason.GARBLED
            noted = [entry for entry in logs if entry["event"] == "frame garbled"]
            assert [entry["bytes"] for entry in noted] == [OVERLOAD[:-2].hex(" ")]  # once
            assert "a frame that listen does not know" in device.diagnosis()
            bench.say(STABLE)
            assert bench.last("weight") == 1234.5
            assert device.diagnosis() == ""


@on_virtual_time
async def test_a_garbled_field_is_bad_alone_and_its_bytes_are_in_the_log() -> None:
    with capture_logs() as logs:
        async with running(example("scale")) as bench:
            bench.say(STABLE * 2)
            bench.say(b"US,+1.2.3.4.  g\r\n" * 3)
            assert bench.last("weight") is Reason.GARBLED
            assert bench.last("state") == "US"
            assert bench.line.engine.devices[0].record.failures == {"shape": 3}
    (noted,) = [entry for entry in logs if entry["event"] == "field garbled"]
    assert noted["bytes"] == b"US,+1.2.3.4.  g".hex(" ")


@on_virtual_time
async def test_two_equal_bar_codes_are_two_events_in_order() -> None:
    async with running(example("barcode-reader")) as bench:
        _, tag = bench.tag("barcode")
        assert tag.publishing.event
        bench.say(b"\x024006381333931\x03\x024006381333931\x03\x024006")
        bench.say(b"381333948\x03")
        codes = bench.values("barcode")
        assert codes == ["4006381333931", "4006381333931", "4006381333948"]


@on_virtual_time
async def test_each_of_two_equal_events_is_published() -> None:
    config = load(EXAMPLES / "barcode-reader.yaml")
    news: list[Value | Reason | None] = []
    bench = Bench()
    gateway = Plant(config, lambda: int(now() * SECOND), lambda _: bench.open)

    class Publisher:
        def publish(self, samples: Sequence[Sample]) -> None:
            news.extend(s.reason or s.value for s in samples)

        def set_online(self, device: str, online: bool) -> None: ...

    gateway.subscribe(Publisher())
    tasks = [asyncio.create_task(line.run()) for line in gateway.lines]
    await asyncio.sleep(0.1)
    bench.say(b"\x02A\x03\x02A\x03")
    bench.say(b"\x02B\x03\x02A\x03?")
    bench.say(b"\x02A\x03")
    assert news == ["A", "A", "B", "A", "A"]
    bench.say(b"\x02a\x03")  # no such code
    assert news[5:] == [Reason.GARBLED]
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


async def test_an_event_is_not_published_again_when_the_link_returns() -> None:
    tags = [tag for name in ("barcode-reader", "scale") for tag in example(name).devices[0].tags]
    repeated: list[Sample] = []

    class Everything:
        def __init__(self) -> None:
            self.tags = tags

        def tag(self, key: str) -> Tag:
            return next(tag for tag in tags if tag.key == key)

        def sample(self, tag: Tag) -> Sample:
            return good(tag, 1, 0)

        def mark_published(self, samples: Sequence[Sample]) -> None:
            pass

    everything: Any = Everything()
    republisher = Republisher(
        repeated.extend, everything, everything, everything, everything, 600.0, nothing
    )
    await republisher.publish_all()
    assert [sample.tag.key for sample in repeated] == ["scale/weight", "scale/state"]


@on_virtual_time
async def test_a_device_that_sends_nothing_costs_nothing() -> None:
    """Nothing is sent, and the line does not even wake."""
    async with running(example("barcode-reader")) as bench:
        rounds = 0
        original = bench.line.engine.next

        def counted(now: float) -> Job:
            nonlocal rounds
            rounds += 1
            return original(now)

        bench.line.engine.next = counted  # type: ignore[method-assign]  # it counts
        asyncio.get_running_loop().call_later(86400, lambda: None)
        await asyncio.sleep(86400)
        assert rounds == 0
        assert bench.sent == []


@on_virtual_time
async def test_a_frame_ended_by_silence_is_read_after_the_silence(tmp_path: Path) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text(
        "lines: {hall: {port: /dev/ttyS1, devices: {scale: {protocol: frames, framing: {gap: 50ms},"
        " listen: {w: {match: 'W(?P<w>[0-9]{1,5})', fields: {w: {type: integer}}}},"
        " tags: {w: {address: w}}}}}}"
    )
    async with running(load(path)) as bench:
        bench.say(b"W12")
        await asyncio.sleep(0.04)
        bench.say(b"34")
        assert bench.values("w") == []
        await asyncio.sleep(0.045)
        assert bench.values("w") == []
        await asyncio.sleep(0.01)
        assert bench.values("w") == [1234]


# Replies


@on_virtual_time
async def test_the_k120s_weighing_machine_gets_a_reply_every_time() -> None:
    frame, answer = BY_ID["noproto-k120s-001"].frame, BY_ID["noproto-k120s-002"].frame
    async with running(example("weighing-machine")) as bench:
        await asyncio.sleep(1)
        for _ in range(3):
            bench.say(frame)
            await asyncio.sleep(0.1)
        assert bench.values("weight") == [0x3412] * 3
        assert bench.words == [answer] * 3
        bench.say(frame[:3] + frame[4:])  # a byte was lost
        await asyncio.sleep(1)
        assert bench.words == [answer] * 3
        assert bench.last("weight") is Reason.GARBLED


@on_virtual_time
async def test_the_echo_of_a_reply_is_no_frame_of_the_device() -> None:
    frame, answer = BY_ID["noproto-k120s-001"].frame, BY_ID["noproto-k120s-002"].frame
    async with running(example("weighing-machine"), echo=True) as bench:
        await asyncio.sleep(1)
        for _ in range(3):
            bench.say(frame)
            await asyncio.sleep(0.5)
        assert bench.words == [answer] * 3
        assert bench.values("weight") == [0x3412] * 3


@on_virtual_time
async def test_a_reply_that_its_framing_cannot_carry_is_not_sent(tmp_path: Path) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text(
        "lines: {hall: {port: /dev/ttyS1, devices: {plc: {protocol: frames,"
        " framing: {header: '<STX>', terminator: '<ETX>'}, send_framing: {terminator: '!'},"
        " listen: {w: {match: '(?P<w>.{1,5})', fields: {w: {type: text}}, answer: 'OK{w}'}},"
        " tags: {w: {address: w}}}}}}"
    )
    async with running(load(path)) as bench:
        bench.say(b"\x02AB\x03\x02A!B\x03")
        await asyncio.sleep(1)
        assert bench.values("w") == ["AB", "A!B"]
        assert bench.words == [b"OKAB!"]


# Polls and writes


def sums(text: str) -> bytes:
    """A frame of the inverter, with the sum as its framing has it."""
    data = text.encode() + b"\x03"
    return b"\x02" + data + b"%02X" % (sum(data) % 256)


class Inverter:
    def __init__(self) -> None:
        self.mute = False
        self.frequency = "049.98"
        self.set: list[bytes] = []

    def __call__(self, request: bytes) -> bytes:
        if self.mute:
            return b""
        if request == sums("F?"):
            return sums(f"F={self.frequency}")
        if request.startswith(b"\x02S="):
            self.set.append(request[3:9])
            return sums("ER07" if request[3:9] == b"013.00" else "OK")
        raise AssertionError(request)


@on_virtual_time
async def test_an_inverter_is_polled_every_half_second() -> None:
    async with running(example("inverter"), replies=Inverter()) as bench:
        await asyncio.sleep(10)
        assert 18 <= len(bench.values("frequency")) <= 22
        assert set(bench.values("frequency")) == {49.98}
        assert set(bench.words) == {sums("F?")}
        assert bench.onlines == [True]


@on_virtual_time
async def test_the_speed_of_an_inverter_is_written() -> None:
    inverter = Inverter()
    async with running(example("inverter"), replies=inverter) as bench:
        await asyncio.sleep(1)
        done = await bench.write_tag("setpoint", 25)
        assert isinstance(done, WriteResult)
        assert (done.value, done.acknowledged) == (25.0, True)
        refused = await bench.write_tag("setpoint", 13)
        assert isinstance(refused, Refused)
        assert refused.code == "07"
        assert inverter.set == [b"025.00", b"013.00"]


@on_virtual_time
async def test_a_limit_holds_for_the_value_that_is_sent() -> None:
    async with running(example("inverter"), replies=Inverter()) as bench:
        _, tag = bench.tag("setpoint")
        assert bytes(tag.encode(60)) == b"060.00"
        assert bytes(tag.encode(24.996)) == b"025.00"
        assert tag.from_units(tag.encode(24.996)) == 25.0
        for value in (60.004, 60.01, -0.01, "25", True, 1e300):
            with pytest.raises(GatewayError):
                tag.encode(value)


@on_virtual_time
async def test_a_reply_with_a_garbled_field_turns_it_bad_and_the_device_stays_online() -> None:
    inverter = Inverter()
    async with running(example("inverter"), replies=inverter) as bench:
        await asyncio.sleep(1)
        inverter.frequency = "0.49.9"
        await asyncio.sleep(2)
        assert bench.last("frequency") is Reason.GARBLED
        assert bench.onlines == [True]
        inverter.frequency = "012.50"
        await asyncio.sleep(1)
        assert bench.last("frequency") == 12.5


@on_virtual_time
async def test_an_inverter_that_is_switched_off_goes_offline_and_is_probed_with_its_request() -> (
    None
):
    inverter = Inverter()
    async with running(example("inverter"), replies=inverter) as bench:
        await asyncio.sleep(1)
        inverter.mute = True
        await asyncio.sleep(12)
        assert bench.last("frequency") is Reason.NO_REPLY
        assert bench.onlines == [True, False]
        inverter.mute = False
        await asyncio.sleep(61)
        assert bench.last("frequency") == 49.98
        assert bench.onlines == [True, False, True]


@pytest.mark.parametrize("number", [0, 1], ids=["as-text", "converted"])
@on_virtual_time
async def test_b_4_5_both_programs_read_d0_and_write_d1_by_configuration_alone(number: int) -> None:
    station = VigorStation(1)
    station.memory.write("D", 0, [0x1234])

    def replies(request: bytes) -> bytes:
        return b"".join(station.hear(request, now()))

    async with running(example("vb-1com"), number, replies=replies) as bench:
        await asyncio.sleep(2)
        assert bench.words[0] == BY_ID["vigor-012"].frame
        assert set(bench.values("d0")) == {0x1234}
        station.memory.write("D", 0, [0xA325])
        await asyncio.sleep(1)
        assert bench.last("d0") == 0xA325 - 0x10000
        assert isinstance(await bench.write_tag("d1", -2), WriteResult)
        assert station.memory.read("D", 1) == [0xFFFE]
        station.memory.holes.add(("D", 1))
        refused = await bench.write_tag("d1", 5)
        assert isinstance(refused, Refused)
        assert refused.code == "28"


READ_BACK = """
lines:
  hall:
    port: /dev/ttyS1
    devices:
      drive:
        protocol: frames
        framing: {gap: 50ms, max_length: 32}
        ask:
          speed: {send: "R", match: 'R(?P<speed>[0-9.]{5})', fields: {speed: {type: decimal}}}
        write: {speed: {send: "W{value}", value: {type: decimal, format: 05.1f}, match: K}}
        tags:
          speed: {address: speed, scale: 0.1, every: 1s, write: {max: 99, verify: true}}
"""


@on_virtual_time
async def test_a_reply_ends_by_a_silence_and_a_write_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text(READ_BACK)
    held, deaf = b"100.0", False

    def replies(request: bytes) -> bytes:
        nonlocal held
        if request == b"R":
            return b"R" + held
        assert request[:1] == b"W"
        held = held if deaf else request[1:]
        return b"K"

    async with running(load(path), replies=replies) as bench:
        await asyncio.sleep(3)
        assert set(bench.values("speed")) == {10.0}
        done = await bench.write_tag("speed", 60)
        assert isinstance(done, WriteResult)
        assert (held, done.value, done.verified) == (b"600.0", 60.0, True)
        deaf = True  # it acknowledges and does nothing
        assert isinstance(await bench.write_tag("speed", 70), Differs)
        await asyncio.sleep(2)
        assert bench.last("speed") == 60.0


PRINTER = """
lines:
  hall:
    port: /dev/ttyS1
    devices:
      printer:
        protocol: frames
        framing: {ending: CR}
        listen: {state: {match: '(?P<state>[A-Z]{1,8})', fields: {state: {type: text}}}}
        write:
          loud:  {send: "PRINT {value}", value: {type: text}}
          proud: {send: "SET {value}", value: {type: integer, format: 03d}, match: OK}
        tags:
          state: {address: state}
          loud:  {address: loud, write: true}
          proud: {address: proud, write: true}
"""


@on_virtual_time
async def test_a_device_without_polls_is_written_but_never_probed(tmp_path: Path) -> None:
    """Only its own frames show that it is online; each write is sent though others failed."""
    path = tmp_path / "plant.yaml"
    path.write_text(PRINTER)
    async with running(load(path)) as bench:
        (device,) = bench.line.engine.devices
        done = await bench.write_tag("loud", "HELLO")
        assert isinstance(done, WriteResult)
        assert done.acknowledged is False
        assert bench.onlines == []
        for _ in range(5):
            assert not isinstance(await bench.write_tag("proud", 7), WriteResult)
        assert bench.onlines == []
        await asyncio.sleep(100)
        assert bench.words == [b"PRINT HELLO\r", *[b"SET 007\r"] * 5]
        bench.replies = lambda _: b"OK\r"
        assert isinstance(await bench.write_tag("proud", 8), WriteResult)
        assert bench.onlines == [True]
        assert device.state is State.ONLINE
        assert bench.values("state") == []


POLLED_AND_UNSOLICITED = """
lines:
  hall:
    port: /dev/ttyS1
    devices:
      scale:
        protocol: frames
        framing: {header: "<STX>", terminator: "<ETX>"}
        listen: {key: {match: 'K(?P<key>[0-9])', fields: {key: {type: integer}}}}
        ask:
          weight: {send: W, match: 'W(?P<w>[0-9]{1,5})', fields: {w: {type: integer}}}
        tags:
          key:    {address: key, event: true}
          weight: {address: w, every: 200ms}
"""


@on_virtual_time
async def test_an_unsolicited_frame_during_a_poll_is_not_lost(
    tmp_path: Path,
) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text(POLLED_AND_UNSOLICITED)
    async with running(load(path), replies=lambda _: b"\x02K7\x03\x02W12\x03") as bench:
        await asyncio.sleep(3)
        asked = len(bench.sent)
        assert asked >= 9
        assert bench.values("weight") == [12] * (asked - 2)  # the first two were probes
        assert bench.values("key") == [7] * asked


@on_virtual_time
async def test_an_unsolicited_frame_during_a_poll_of_another_device_is_not_lost(
    tmp_path: Path,
) -> None:
    path = tmp_path / "plant.yaml"
    reader = """
      reader:
        protocol: frames
        framing: {header: "<STX>", terminator: "<ETX>"}
        listen: {scan: {match: 'S(?P<code>[0-9]{1,20})', fields: {code: {type: text}}}}
        tags: {code: {address: code, event: true}}
"""
    silent = [row for row in POLLED_AND_UNSOLICITED.splitlines() if "key" not in row]
    path.write_text("\n".join(silent) + reader)
    async with running(load(path), replies=lambda _: b"\x02S7\x03\x02W12\x03") as bench:
        await asyncio.sleep(3)
        asked = len(bench.sent)
        assert asked >= 9
        assert bench.values("code") == ["7"] * asked
        assert bench.values("weight") == [12] * (asked - 2)


PLAIN = """
lines:
  hall:
    port: /dev/ttyS1
    devices:
      scale:
        protocol: frames
        framing: {terminator: "<CR><LF>"}
        listen: {key: {match: '[+]?(?P<key>[0-9]{1,6})', fields: {key: {type: integer}}}}
        ask:
          weight: {send: W, match: 'W(?P<w>[0-9]{1,5})', fields: {w: {type: integer}}}
        tags:
          key:    {address: key}
          weight: {address: w, every: 40ms}
"""


def plain(folder: Path) -> Config:
    """A polled scale that also sends by itself, without a header."""
    path = folder / "plant.yaml"
    path.write_text(PLAIN)
    return load(path)


@on_virtual_time
async def test_the_end_of_a_frame_whose_head_a_request_covered_is_no_value(tmp_path: Path) -> None:
    async with running(plain(tmp_path), replies=lambda _: b"45\r\nW12\r\n") as bench:
        await asyncio.sleep(3)
        assert set(bench.values("weight")) == {12}
        assert bench.values("key") == []


@on_virtual_time
async def test_frames_without_a_header_are_heard_between_polls_of_a_busy_line(
    tmp_path: Path,
) -> None:
    async with running(plain(tmp_path), replies=lambda _: b"W12\r\n") as bench:
        await asyncio.sleep(1)
        said = 0
        for _ in range(200):
            await asyncio.sleep(0.0501)
            if now() - bench.sent[-1][0] < 2 * bench.pause:
                continue
            said += 1
            bench.say(b"+000123\r\n")
        assert said > 80
        assert bench.values("key") == [123] * said


@on_virtual_time
async def test_a_frame_that_begins_with_the_end_of_a_reply_waits_for_a_silence(
    tmp_path: Path,
) -> None:
    async with running(plain(tmp_path), replies=lambda _: b"W12\r\n+0001") as bench:
        await asyncio.sleep(1)
        finished = 0
        for _ in range(200):
            await asyncio.sleep(0.0101)
            if len(bench.sent) > finished and bench.pause < now() - bench.sent[-1][0] < 0.03:
                finished = len(bench.sent)
                bench.say(b"23\r\n")
        assert finished > 40
        assert set(bench.values("weight")) == {12}
        assert bench.values("key") == []


SHARED = """
lines:
  hall:
    port: /dev/ttyS1
    baudrate: 9600
    format: 8N1
    devices:
      mixer:
        protocol: vigor
        station: 1
        format: 8N1
        tags: {speed: {address: D0, every: 100ms}}
      reader:
        protocol: frames
        framing: {header: "<STX>", terminator: "<ETX>"}
        listen: {scan: {match: '(?P<code>[0-9]{1,20})', fields: {code: {type: text}}}}
        tags: {code: {address: code, event: true}}
"""


@on_virtual_time
async def test_a_reader_and_a_polled_plc_share_a_line(tmp_path: Path) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text(SHARED)
    station = VigorStation(1)
    station.memory.write("D", 0, [42])

    def replies(request: bytes) -> bytes:
        return b"".join(station.hear(request, now()))

    async with running(load(path), replies=replies) as bench:
        await asyncio.sleep(2)  # the first device replies, and the wire is quiet
        said = 0
        for n in range(100):
            await asyncio.sleep(0.173)
            if bench.sent and now() - bench.sent[-1][0] < 2 * bench.pause:
                continue  # a poll is in flight: both frames would be lost
            said += 1
            before = len(bench.sent)
            bench.say(b"\x0240063")
            await asyncio.sleep(0.03)
            assert len(bench.sent) == before  # the frame is not interrupted
            bench.say(b"%03d\x03" % n)
        assert said > 50
        assert len(bench.values("code")) == said
        assert set(bench.values("speed")) == {42}
        assert len(bench.values("speed")) > 80


@on_virtual_time
async def test_an_endless_frame_keeps_the_line_only_for_a_while(tmp_path: Path) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text(SHARED)
    station = VigorStation(1)

    def replies(request: bytes) -> bytes:
        return b"".join(station.hear(request, now()))

    async with running(load(path), replies=replies) as bench:
        await asyncio.sleep(1)
        begun, polled = now(), len(bench.sent)
        for _ in range(300):
            bench.say(b"\x02")
            await asyncio.sleep(0.008)
        waited = bench.sent[polled][0] - begun
        assert waited < 1.2
        await asyncio.sleep(1)
        assert bench.last("speed") == 0


@on_virtual_time
async def test_a_reply_that_waited_too_long_is_not_sent() -> None:
    frame = BY_ID["noproto-k120s-001"].frame
    async with running(example("weighing-machine")) as bench:
        await asyncio.sleep(1)
        bench.say(frame)
        assert isinstance(bench.line.engine.next(now() + REPLY_WITHIN), Idle)  # the line was busy
        await asyncio.sleep(1)
        assert bench.sent == []


@on_virtual_time
async def test_listening_begins_again_when_the_port_was_lost_and_reopened() -> None:
    bench = Bench()
    bench.line = made_line(example("scale").lines[0], bench)
    task = asyncio.create_task(bench.line.run())
    await asyncio.sleep(0.1)
    bench.say(STABLE + STABLE[:7])
    bench.line.lost(LineDown("unplugged"))
    await asyncio.sleep(0.1)
    assert bench.last("weight") is Reason.LINE_DOWN
    await asyncio.sleep(1)
    bench.say(STABLE[7:] + MOVING)
    assert bench.values("weight")[-1] == -12.0
    assert 1234.5 not in bench.values("weight")[1:]
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


@pytest.mark.parametrize(
    "name", ["scale", "barcode-reader", "inverter", "weighing-machine", "vb-1com"]
)
@settings(max_examples=30)
@given(
    pieces=st.lists(
        st.tuples(
            st.one_of(
                st.binary(max_size=40), st.sampled_from([STABLE, b"\x02123\x03", sums("OK")])
            ),
            st.sampled_from([0.0, 0.004, 0.06, 0.5]),
        ),
        max_size=25,
    )
)
def test_no_received_bytes_end_the_line(name: str, pieces: list[tuple[bytes, float]]) -> None:
    async def receive() -> None:
        async with running(example(name)) as bench:
            for data, pause in pieces:
                bench.say(data)
                await asyncio.sleep(pause)
            await asyncio.sleep(1)

    loop = VirtualLoop()
    try:
        loop.run_until_complete(receive())
    finally:
        loop.close()
