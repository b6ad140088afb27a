"""Doors of a simulated plant, on a virtual clock: programs without a socket."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from itertools import pairwise
from struct import pack
from typing import Any, NoReturn

import orjson
import pytest

from gateway.config import built
from gateway.config.messages import ConfigErrors
from gateway.contract.keys import Keys
from gateway.errors import NoReply, Refused
from gateway.line.send_permit import SendPermit
from gateway.northbound.requests.audit import Audit
from gateway.northbound.requests.writes import OwnWrites
from gateway.parts.doors.guest import MOST_WAITING, Guest
from gateway.parts.doors.guest_requests import NO_REPLY, NOT_NOW, GuestRequests
from gateway.parts.doors.open_door import HELD, OpenDoor
from gateway.parts.doors.plan import door_plans, door_warnings
from gateway.parts.doors.repeated_reads import MOST_KEPT, RepeatedReads
from gateway.parts.doors.settings import Sharing
from gateway.parts.doors.stores import Step
from gateway.parts.doors.tunnel import Tunnel
from gateway.parts.transfers.forecast import forecasts
from gateway.plant.plant import Plant
from gateway.protocols.driver import Span
from gateway.protocols.modbus.frame import Frame
from gateway.protocols.modbus.rtu import encode
from gateway.stations.store import Rejected
from gateway.tags import Tag, WriteResult
from gateway.values import Value
from tests.serving.easy_link import frame as vigor_frame
from tests.serving.test_computer_link import request as link_request
from tests.sim.virtual import now, on_virtual_time

LINES: dict[str, Any] = {
    "hall": {
        "port": "simulator",
        "baudrate": 19200,
        "devices": {
            "press": {
                "protocol": "modbus-rtu",
                "station": 1,
                "tags": {"speed": {"address": "holding:0", "every": "100ms"}},
            }
        },
    },
    "ovens": {
        "port": "simulator",
        "devices": {
            "oven": {"protocol": "vigor", "station": 3, "tags": {"t": {"address": "D100"}}}
        },
    },
    "link": {
        "port": "simulator",
        "devices": {
            "mixer": {
                "protocol": "computer-link",
                "station": 5,
                "tags": {"t": {"address": "D0100"}},
            }
        },
    },
}
PRESS = LINES["hall"]["devices"]["press"]
WRITES = {"press": ["holding:10..19", "coil:0..7"]}


def door(line: str, protocol: str, **settings: Any) -> dict[str, Any]:
    return {"line": line, "listen": "127.0.0.1:1502", "protocol": protocol, **settings}


@dataclass(eq=False)
class Program:
    """One connection of a door, and what arrives there."""

    door: OpenDoor
    replies: list[tuple[float, bytes]] = field(default_factory=list)
    closed: bool = False
    guest: Guest | Tunnel = field(init=False)

    def __post_init__(self) -> None:
        guest = self.door.connect("127.0.0.1")
        assert guest is not None
        self.guest = guest
        guest.opened(self)

    def write(self, data: bytes) -> None:
        self.replies.append((now(), data))

    async def close(self) -> None:
        self.closed = True

    async def ask(self, request: bytes, wait: float = 3.0) -> bytes:
        """Returns what arrives in so many seconds."""
        self.replies.clear()
        self.guest.received(request)
        await asyncio.sleep(wait)
        return b"".join(data for _, data in self.replies)


class _End(Exception):
    """The end of a test: it ends the lines and programs."""


def _end() -> NoReturn:
    raise _End


@dataclass(eq=False)
class Hall:
    """The plant, its door `laptop`, and the second door."""

    plant: Plant
    door: OpenDoor
    outcomes: list[bytes]
    second: OpenDoor | None = None
    held: dict[str, float] = field(default_factory=dict)  # "until": the process stood still


@asynccontextmanager
async def opened(
    settings: dict[str, Any], lines: Any = LINES, **second: dict[str, Any]
) -> AsyncIterator[Hall]:
    config = built({"lines": lines, "share": {"doors": {"laptop": settings, **second}}})
    held: dict[str, float] = {"until": -1e9}
    duty = SendPermit(lambda: held["until"])
    plant = Plant(config, lambda: int(now() * 1e9), duty=duty)
    outcomes: list[bytes] = []
    own = OwnWrites(Keys("plant", "demo"), plant, Audit(outcomes.append))

    class North:
        async def write_own(
            self, tag: Tag, value: Value, by: str, within: float, *, repeated: bool = True
        ) -> WriteResult:
            return await own.write(tag, value, by, within, repeated=repeated)

        deny_own = staticmethod(own.deny)

    def keep(_at: int, event: str) -> None:
        outcomes.append(event.encode())

    sharing = config.part(Sharing)
    assert sharing is not None
    north: Any = North()
    try:
        async with asyncio.TaskGroup() as tasks:
            asks = GuestRequests(plant.any_address, north)
            made = [OpenDoor(one, asks, plant, tasks, keep) for one in sharing.doors]
            for line in plant.lines:
                tasks.create_task(line.run())
            await asyncio.sleep(2)
            yield Hall(plant, made[0], outcomes, made[-1], held)
            _end()
    except* _End:
        pass


def rtu(pdu: str, station: int = 1) -> bytes:
    return encode(Frame(station, bytes.fromhex(pdu)))


def tcp(pdu: str, number: int = 7, station: int = 1) -> bytes:
    data = bytes.fromhex(pdu)
    return pack(">HHHB", number, 0, len(data) + 1, station) + data


@on_virtual_time
async def test_a_program_reads_and_writes_by_rtu() -> None:
    async with opened(door("hall", "modbus-rtu", writes=WRITES)) as hall:
        program = Program(hall.door)
        assert await program.ask(rtu("06 000a 1234")) == rtu("06 000a 1234")
        assert await program.ask(rtu("10 000b 0002 04 0001 0002")) == rtu("10 000b 0002")
        assert await program.ask(rtu("03 000a 0003")) == rtu("03 06 1234 0001 0002")
        assert await program.ask(rtu("05 0003 ff00")) == rtu("05 0003 ff00")
        assert await program.ask(rtu("01 0000 0008")) == rtu("01 01 08")
        assert len(hall.outcomes) == 3
        assert b'"by":"door laptop, 127.0.0.1"' in hall.outcomes[0]
        assert all(b'"origin":"simulated"' in outcome for outcome in hall.outcomes)


@on_virtual_time
async def test_nothing_is_written_but_what_the_file_names() -> None:
    async with opened(door("hall", "modbus-rtu", writes=WRITES)) as hall:
        program = Program(hall.door)
        for pdu in ("06 0009 0001", "06 0014 0001", "10 0013 0002 04 0001 0002", "05 0008 ff00"):
            function = int(pdu[:2], 16)
            assert await program.ask(rtu(pdu)) == rtu(f"{function | 0x80:02x} 02")
        said = [orjson.loads(outcome) for outcome in hall.outcomes]
        assert [one["outcome"] for one in said] == 4 * ["not-writable"]
        assert said[1]["by"] == "door laptop, 127.0.0.1"
        assert (said[2]["value"], said[2]["reason"]) == (
            [1, 2],
            "`writes` of door laptop does not name it",
        )
        [told] = hall.door.document(now())["programs"]
        assert (told["requests"], told["writes"], told["refused"]) == (4, 0, 4)


@on_virtual_time
async def test_a_door_without_writes_only_reads() -> None:
    async with opened(door("hall", "modbus-tcp")) as hall:
        program = Program(hall.door)
        assert await program.ask(tcp("06 000a 0001")) == tcp("86 02")
        assert await program.ask(tcp("03 000a 0001")) == tcp("03 02 0000")


@on_virtual_time
async def test_requests_behind_one_another_are_answered_in_their_order() -> None:
    async with opened(door("hall", "modbus-tcp", writes=WRITES, most="99%")) as hall:
        program = Program(hall.door)
        asked = [tcp("03 000a 0001", 1), tcp("06 000a 0005", 2), tcp("03 000a 0001", 3)]
        answer = await program.ask(b"".join(asked[:2]) + asked[2][:5])
        answer += await program.ask(asked[2][5:])
        told = [tcp("03 02 0000", 1), tcp("06 000a 0005", 2), tcp("03 02 0005", 3)]
        assert answer == b"".join(told)
        assert await program.ask(tcp("03 000a 0001", 4, station=9)) == tcp("83 0a", 4, station=9)


@on_virtual_time
async def test_each_of_several_requests_in_one_packet_is_done() -> None:
    """They were joined to one: of a pulse only its end was written, and both were acknowledged."""
    async with opened(door("hall", "modbus-tcp", writes=WRITES, most="99%")) as hall:
        program = Program(hall.door)
        pulse = tcp("05 0003 ff00", 1), tcp("05 0003 0000", 2)
        assert await program.ask(b"".join(pulse)) == b"".join(pulse)
        values = [orjson.loads(outcome)["value"] for outcome in hall.outcomes]
        assert values == [True, False]
        asked = [tcp("06 000b 0001", 3), tcp("06 00ff 0007", 4), tcp("06 000a 0002", 5)]
        told = [asked[0], tcp("86 02", 4), asked[2]]
        assert await program.ask(b"".join(asked)) == b"".join(told)
        keys = [orjson.loads(outcome)["key"] for outcome in hall.outcomes[2:]]
        assert [key.rpartition("-")[2] for key in keys] == ["11", "255", "10"]  # 255: denied


@on_virtual_time
async def test_a_request_that_is_done_in_part_is_not_refused() -> None:
    """The first register is written, the device refuses the second: NAK means that nothing is."""
    async with opened(door("link", "computer-link", writes={"mixer": ["D0..D99"]})) as hall:
        done = list[Tag]()

        class Refuses:
            async def write_own(self, tag: Tag, value: Value, *_: Any, **_how: Any) -> WriteResult:
                if done:
                    raise Refused("there is no D20", code="06")
                done.append(tag)
                return WriteResult(value, 0, 0.0)

        north: Any = Refuses()
        asks, step = GuestRequests(hall.plant.any_address, north), Step("mixer", writes=True)
        step.cells |= {("D", 10): 1, ("D", 20): 2}
        assert await asks.carry_out(step, hall.door.settings, "a test", 1.0) is NO_REPLY
        again = await asks.carry_out(step, hall.door.settings, "a test", 1.0)
        assert isinstance(again, Rejected)  # nothing was done this time
        assert again.code == "06"


@on_virtual_time
async def test_programs_of_vigor_and_computer_link_plcs() -> None:
    async with opened(door("ovens", "vigor", writes={"oven": ["D10..D19"]})) as hall:
        program = Program(hall.door)
        written = await program.ask(vigor_frame(3, "61", "1C14043412CDAB"))
        assert written[1:7] == b"036100"
        assert b"3412CDAB" in await program.ask(vigor_frame(3, "51", "1C1404"))
        refused = await program.ask(vigor_frame(3, "61", "1C28043412CDAB"))  # D20
        assert refused[1:7] == b"036128"
    async with opened(door("link", "computer-link", writes={"mixer": ["D0010"]})) as hall:
        program = Program(hall.door)
        assert (await program.ask(link_request("05FFWW0D0010011234"))).startswith(b"\x0605FF")
        assert b"1234" in await program.ask(link_request("05FFWR0D001001"))
        assert (await program.ask(link_request("05FFRS0"))).startswith(b"\x1505FF18")


@on_virtual_time
async def test_a_silent_station_is_silent_at_a_serial_door_and_0b_at_a_network_door() -> None:
    lines = {
        "hall": {
            **LINES["hall"],
            "devices": {
                **LINES["hall"]["devices"],
                "gone": {
                    "protocol": "modbus-rtu",
                    "station": 2,
                    "enabled": False,
                    "tags": {"t": {"address": "holding:0"}},
                },
            },
        }
    }
    async with opened(door("hall", "modbus-tcp"), lines) as hall:
        assert await Program(hall.door).ask(tcp("03 0000 0001", station=2)) == tcp(
            "83 0a", station=2
        )
        hall.plant.move(["press"], hall.plant.lines[0])
        assert await Program(hall.door).ask(tcp("03 0000 0001")) == tcp("83 0b")
    async with opened(door("hall", "modbus-rtu"), lines) as hall:
        hall.plant.move(["press"], hall.plant.lines[0])
        program = Program(hall.door)
        assert await program.ask(rtu("03 0000 0001")) == b""
        [told] = hall.door.document(now())["programs"]
        assert told["unanswered"] == 1


@on_virtual_time
async def test_a_reply_is_dropped_when_the_program_has_gone_on() -> None:
    async with opened(door("hall", "modbus-rtu", most="1%", reply_within="10s")) as hall:
        program = Program(hall.door)
        first = await program.ask(rtu("03 000a 0001"), wait=0.2)  # its share is used up now
        assert first == rtu("03 02 0000")
        assert await program.ask(rtu("03 000a 0002"), wait=0.2) == b""
        assert await program.ask(rtu("03 000a 0003"), wait=8.0) == rtu("03 06" + "00" * 6)


@on_virtual_time
async def test_a_reply_is_dropped_when_it_is_late() -> None:
    async with opened(door("hall", "modbus-rtu", most="1%")) as hall:
        program = Program(hall.door)
        await program.ask(rtu("03 000a 007d"), wait=1.0)
        assert await program.ask(rtu("03 000a 0001"), wait=30.0) == b""
        assert await program.ask(rtu("03 000a 0001")) == rtu("03 02 0000")


@on_virtual_time
async def test_programs_get_their_share_and_no_more() -> None:
    async with opened(door("hall", "modbus-tcp", most="30%")) as hall:
        programs = [Program(hall.door) for _ in range(2)]
        times = list[float]()
        hall.plant.doors.seers = [lambda _: times.append(now())]

        async def flood(program: Program) -> None:
            while True:
                await program.ask(tcp("03 0064 007d"), wait=0.05)

        floods = [asyncio.create_task(flood(one)) for one in programs]
        await asyncio.sleep(20)
        for one in floods:
            one.cancel()
        ages = [after - before for before, after in pairwise(times)]
        assert len(ages) > 190  # of 200 without programs
        assert max(ages) < 2 * 0.1 + 0.15  # one long request of a program is under way
        # The share is measured over a minute.
        assert 0.06 < hall.door.document(now())["share"] < 0.31


@on_virtual_time
async def test_programs_give_way_while_polls_are_lost() -> None:
    """Polls need four fifths of the wire, and two programs want all of it: 14 % were lost."""
    tags = {
        f"t{n}": {"address": f"holding:{1000 + 200 * n}", "type": "uint16[30]"} for n in range(10)
    }
    press = {**PRESS, "tags": tags, "defaults": {"every": "600ms"}}
    settings = door("hall", "modbus-tcp", most="30%", reply_within="5s")
    async with opened(settings, {"hall": {**LINES["hall"], "devices": {"press": press}}}) as hall:
        seen, replies = list[float](), 0
        hall.plant.doors.seers = [lambda _: seen.append(now())]

        async def flood(program: Program) -> None:
            nonlocal replies
            while True:
                replies += bool(await program.ask(tcp("03 0064 007d"), wait=0.05))

        begun = now()
        floods = [asyncio.create_task(flood(Program(hall.door))) for _ in range(2)]
        await asyncio.sleep(60)
        for one in floods:
            one.cancel()
        assert len(seen) > 0.95 * 10 * (now() - begun) / 0.6
        assert replies > 20
        assert hall.door.document(now())["share"] > 0.05  # of the minute; a third of theirs is 0.1


@on_virtual_time
async def test_a_door_that_waits_for_its_share_holds_up_no_other_door() -> None:
    """Its program had the turn of the line while it waited, and those of other doors waited too."""
    small = door("hall", "modbus-tcp", most="1%", reply_within="10s")
    large = {**door("hall", "modbus-tcp", most="90%"), "listen": "127.0.0.1:1503"}
    async with opened(small, panel=large) as hall:
        assert hall.second is not None
        greedy, panel = [Program(hall.door) for _ in range(3)], Program(hall.second)
        for one in greedy:
            for number in range(20):
                one.guest.received(tcp("03 0064 0001", number=number))
        await asyncio.sleep(3)
        for _ in range(10):
            assert len(await panel.ask(tcp("03 0064 0001"), wait=0.5)) == 7 + 4


@on_virtual_time
async def test_a_read_that_needs_several_requests_costs_them_all() -> None:
    """It was free: programs took two thirds of the wire with `most: 5%`."""
    press = {**PRESS, "max_read_words": 10}
    lines = {"hall": {**LINES["hall"], "devices": {"press": press}}}
    async with opened(door("hall", "modbus-tcp", most="5%", reply_within="10s"), lines) as hall:
        program = Program(hall.door)
        assert len(await program.ask(tcp("03 0064 007d"))) == 7 + 2 + 250
        assert 0.003 < hall.door.document(now())["share"] < 0.02  # 13 requests in a minute
        assert await program.ask(tcp("03 0064 007d")) == b""  # its time is used up for a while


class Slow:
    """Addresses that take 3 s of the line to read, and time out. In place of `AnyAddress`."""

    spent = resynced = 0.0

    def requested(self, _device: str) -> float:
        return self.spent

    def resyncs(self, _device: str) -> float:
        return self.resynced

    def is_late(self, _device: str) -> bool:
        return False

    async def read(self, *_: object) -> list[int]:
        await asyncio.sleep(3)
        self.spent += 3
        raise NoReply("no reply")


@on_virtual_time
async def test_the_time_of_a_share_is_measured_and_each_door_has_its_own() -> None:
    """It was that of the plan: a silent address cost 30 ms of the share, and 1 s of the wire."""
    async with opened(door("hall", "modbus-tcp", most="90%")) as hall:
        small, large = (replace(hall.door.settings, name=f"{n}", most=n / 100) for n in (10, 90))
        slow: Any = Slow()
        north: Any = None
        turns, step = GuestRequests(slow, north), Step("press", writes=False)
        step.cells["holding", 10] = 0
        assert await turns.carry_out(step, small, "a test", 10.0) is NO_REPLY
        assert 60 * turns.share(now()) == pytest.approx(3.0)
        assert await turns.carry_out(step, small, "a test", 20.0) is NOT_NOW  # 3 s / 10 % is 30 s
        assert await turns.carry_out(step, large, "a test", 1.0) is NO_REPLY
        assert await turns.carry_out(step, small, "a test", 30.0) is NO_REPLY
        slow.resynced = 0.5  # that of the last request: it was free
        assert await turns.carry_out(step, small, "a test", 31.0) is NOT_NOW
        assert await turns.carry_out(step, small, "a test", 36.0) is NO_REPLY


@on_virtual_time
async def test_a_program_that_pours_is_disconnected() -> None:
    async with opened(door("hall", "modbus-tcp")) as hall:
        program = Program(hall.door)
        program.guest.received(tcp("03 0000 0001") * (MOST_WAITING // 12 + 1))
        await asyncio.sleep(1)
        assert program.closed
        assert hall.door.document(now())["programs"] == []


@on_virtual_time
async def test_only_the_networks_of_the_file_connect() -> None:
    allowed = door("hall", "modbus-tcp", listen="0.0.0.0:1502", allow=["10.1.0.0/16"])
    async with opened(allowed) as hall:
        assert hall.door.connect("10.2.0.1") is None
        assert hall.door.connect("10.1.0.1") is not None
        assert hall.door.document(now())["turned_away"] == 1


def quality(hall: Hall) -> tuple[str, str | None]:
    tag = hall.plant.tag("press/speed")
    assert tag is not None
    sample = hall.plant.sample(tag)
    return sample.quality.value, None if sample.reason is None else sample.reason.value


@on_virtual_time
async def test_a_raw_door_gives_one_program_the_wire_alone() -> None:
    async with opened(door("hall", "raw", idle="10s")) as hall:
        assert quality(hall) == ("good", None)
        program = Program(hall.door)
        assert await program.ask(rtu("10 000a 0001 02 1234")) == rtu("10 000a 0001")
        assert hall.door.connect("127.0.0.1") is None  # it has the wire alone
        assert quality(hall) == ("bad", "maintenance")
        line = hall.plant.lines[0]
        assert line.engine.record.trouble == "laptop (127.0.0.1) has the wire"
        tag = hall.plant.any_address.target("press", Span("holding", 10, 1))
        [ended] = await hall.plant.write_group([(tag, 1)])
        assert "laptop (127.0.0.1) has the wire" in str(ended)
        assert await program.ask(rtu("03 000a 0001")) == rtu("03 02 1234")
        await asyncio.sleep(10.5)  # it says nothing for so long
        assert program.closed
        await asyncio.sleep(15)
        assert quality(hall) == ("good", None)
        [event] = hall.outcomes
        assert b"it had the wire, and sent 19 bytes" in event
        assert b'"by":"door laptop, 127.0.0.1"' in event


@on_virtual_time
async def test_the_wire_comes_back_when_the_program_goes() -> None:
    async with opened(door("hall", "raw")) as hall:
        for _ in range(3):
            program = Program(hall.door)
            assert await program.ask(rtu("03 000a 0001")) == rtu("03 02 0000")
            program.guest.lost(OSError("gone"))
            await asyncio.sleep(0.1)
        await asyncio.sleep(15)
        assert quality(hall) == ("good", None)
        assert hall.door.document(now())["programs"] == []


@on_virtual_time
async def test_the_program_of_another_door_does_not_take_the_wire_from_the_first() -> None:
    """Its end gave the wire back to the line: program and gateway were two masters on it."""
    async with opened(door("hall", "raw"), two=door("hall", "raw", listen="127.0.0.1:2")) as hall:
        first = Program(hall.door)
        assert await first.ask(rtu("03 000a 0001")) == rtu("03 02 0000")
        assert hall.second is not None
        second = Program(hall.second)
        assert await second.ask(rtu("03 000a 0001"), wait=30.0) == b""
        assert second.closed
        assert quality(hall) == ("bad", "maintenance")
        assert await first.ask(rtu("03 000a 0001")) == rtu("03 02 0000")
        first.guest.lost(OSError("gone"))
        await asyncio.sleep(15)
        assert quality(hall) == ("good", None)


@on_virtual_time
async def test_what_a_program_sent_while_the_process_was_held_does_not_reach_the_wire() -> None:
    """Another gateway of the group had the wire meanwhile."""
    async with opened(door("hall", "raw")) as hall:
        program = Program(hall.door)
        assert await program.ask(rtu("06 000a 0001")) == rtu("06 000a 0001")
        hall.held["until"] = now()
        assert await program.ask(rtu("06 000a 0002"), wait=15.0) == b""
        assert program.closed
        assert await Program(hall.door).ask(rtu("03 000a 0001")) == rtu("03 02 0001")


@on_virtual_time
async def test_a_door_whose_devices_belong_to_another_gateway_is_closed() -> None:
    """The part of all doors failed, again and again: no door of the file was open."""
    async with opened(door("hall", "modbus-tcp")) as hall:
        config, plant = hall.plant.config, hall.plant
        plant.move(["press"], plant.lines[0])
        plant.lines[:] = [line for line in plant.lines if line.name != "hall"]
        hall.door.take_over(config.without(["press"]), plant)
        assert hall.door.connect("127.0.0.1") is None
        why = "other gateways have the devices of line hall"
        assert hall.door.document(now())["trouble"] == why


@on_virtual_time
async def test_an_operator_takes_the_wire_back_for_a_minute() -> None:
    async with opened(door("hall", "raw")) as hall:
        program = Program(hall.door)
        assert await program.ask(rtu("03 000a 0001")) == rtu("03 02 0000")
        hall.door.release("zoe")
        await asyncio.sleep(20)
        assert program.closed
        assert quality(hall) == ("good", None)
        assert hall.door.connect("127.0.0.1") is None  # a tool connects again by itself
        assert b"released; 1 connected" in hall.outcomes[0]
        assert b"released by zoe" in hall.outcomes[1]
        await asyncio.sleep(HELD)
        assert await Program(hall.door).ask(rtu("03 000a 0001")) == rtu("03 02 0000")


@on_virtual_time
async def test_a_polled_address_is_answered_by_the_last_poll_if_it_is_young_enough() -> None:
    tags = {f"t{n}": {"address": f"holding:{n}", "write": True} for n in range(8)}
    press = {**PRESS, "defaults": {"every": "2s"}, "tags": tags}
    lines = {"hall": {**LINES["hall"], "devices": {"press": press}}}
    settings = door("hall", "modbus-tcp", writes={"press": ["holding:0..99"]}, max_age="3s")
    async with opened(settings, lines) as hall:
        program, record = Program(hall.door), hall.plant.lines[0].engine.devices[0].record
        await asyncio.sleep(5)

        async def asked(pdu: str) -> tuple[bytes, bool]:
            """Returns the reply, and if the device was asked for it."""
            before, begun = record.exchanges, now()
            program.replies.clear()
            program.guest.received(tcp(pdu))
            while not program.replies:
                await asyncio.sleep(0.001)
            return program.replies[0][1], now() > begun + 0.002 and record.exchanges > before

        def polled(numbers: range) -> bytes:
            tags = [hall.plant.tag(f"press/t{n}") for n in numbers]
            values = [hall.plant.sample(tag).value for tag in tags if tag is not None]
            return tcp(f"03 {2 * len(values):02x}" + "".join(f"{value:04x}" for value in values))

        assert await asked("03 0002 0004") == (polled(range(2, 6)), False)
        assert (await asked("03 0006 0004"))[1]  # a part of it is not polled
        assert (await asked("06 0002 0007"))[1]
        # The poll before the write does not know of it.
        assert (await asked("03 0002 0001"))[0] == tcp("03 02 0007")
        await asyncio.sleep(3)
        assert await asked("03 0002 0003") == (polled(range(2, 5)), False)
        hall.plant.lines[0].engine.devices[0].health.online = False
        assert hall.plant.any_address.known("press", Span("holding", 2, 1), 3.0) is None


@on_virtual_time
async def test_repeated_reads_are_proposed_as_tags() -> None:
    async with opened(door("hall", "modbus-tcp")) as hall:
        program = Program(hall.door)
        for number in range(4):
            await program.ask(tcp("03 000a 0002"), wait=2.0)
            await program.ask(tcp(f"03 01{number:02x} 0001"), wait=0.5)
            await program.ask(tcp("03 0000 0001"), wait=0.5)
        first, second = hall.door.document(now())["reads"]
        assert first == {
            "device": "press",
            "address": "holding:10",
            "type": "uint16[2]",
            "count": 4,
            "every": 3.0,
            "tags": [],
        }
        assert (second["address"], second["tags"]) == ("holding:0", ["speed"])


def test_what_is_kept_of_reads_has_a_bound() -> None:
    reads, device = RepeatedReads(), built({"lines": LINES}).devices[0]
    for at in range(10 * MOST_KEPT):
        reads.note("press", Span("holding", at, 1), at)
        if at % 100 == 0:
            reads.note("press", Span("holding", 9999, 1), at)
    [one] = reads.documents({"press": device})
    assert (one["address"], one["count"], one["every"]) == ("holding:9999", 20, 100.0)


MISTAKES = {
    "remove `allow`": door("hall", "raw", listen="/run/hall-1", allow=["10.1.0.0/16"]),
    "settings, which are followed with `raw`": door("hall", "rfc2217", listen="/run/hall-1"),
    "no address to listen on": door("hall", "raw", listen="run/hall-1"),
    "remove `writes`": door("hall", "raw", writes=WRITES),
    "no line hill: did you mean hall": door("hill", "modbus-tcp"),
    "can be asked by modbus-ascii, modbus-rtu or modbus-tcp": door("hall", "vigor"),
    "other machines can reach 0.0.0.0": door("hall", "modbus-tcp", listen="0.0.0.0:1502"),
    "no device oven: use press": door("hall", "modbus-tcp", writes={"oven": ["D0"]}),
    "1% to 99%": door("hall", "modbus-tcp", most="100%"),
    "at most 10s": door("hall", "modbus-tcp", reply_within="11s"),
    "D0": door("hall", "modbus-tcp", writes={"press": ["D0"]}),
}


@pytest.mark.parametrize("what", MISTAKES)
def test_a_mistake_is_said(what: str) -> None:
    with pytest.raises(ConfigErrors) as found:
        built({"lines": LINES, "share": {"doors": {"laptop": MISTAKES[what]}}})
    [message] = found.value.messages
    assert what in message


def test_a_door_needs_a_line_that_sends() -> None:
    served = {"port": "/dev/ttyS98", "serve": True, "devices": LINES["ovens"]["devices"]}
    with pytest.raises(ConfigErrors, match="another master owns its wire"):
        built({"lines": {"ovens": served}, "share": {"doors": {"one": door("ovens", "vigor")}}})


def test_a_device_that_the_gateway_cannot_serve_has_doors_that_pass_all_on_only() -> None:
    plc = {"protocol": "fx", "tags": {"t": {"address": "D0"}}}
    lines = {"hall": {"port": "/dev/ttyS98", "devices": {"plc": plc}}}
    with pytest.raises(ConfigErrors, match="no device of hall for vigor: none can be asked"):
        built({"lines": lines, "share": {"doors": {"one": door("hall", "vigor")}}})


def test_check_says_who_may_ask_what() -> None:
    settings = door("hall", "modbus-tcp", writes=WRITES, most="90%")
    config = built({"lines": LINES, "share": {"doors": {"laptop": settings}}})
    lines = forecasts(config)
    [text] = door_plans(config, lines)
    assert "press (1) by modbus-tcp" in text
    assert "press holding:10..holding:19, coil:0..coil:7" in text
    [warning] = door_warnings(config, lines)
    assert "line hall is asked for" in warning


def test_the_neighbours_of_a_step() -> None:
    cells = {("D", 5): 1, ("D", 4): 2, ("M", 6): 3, ("D", 7): 4}
    step = Step("press", True, cells)
    runs = [*step.runs()]
    assert runs == [Span("D", 4, 2), Span("D", 7, 1), Span("M", 6, 1)]
    assert step.units(runs[0]) == [2, 1]
    assert [*Step("press", False).runs()] == []
