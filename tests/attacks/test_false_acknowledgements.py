"""At the running gateway: what arrives in place of the acknowledgement of a write is none.

The slaves reply to a broadcast, or their adapter begins to return what it is sent.
"""

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any

from tests.attacks.slave import Slave, crc, program_on
from tests.attacks.test_drive import Drive
from tests.zenoh_peer import Received

WRITE_WORDS = 16
LATEST = 0.5  # seconds after a broadcast; the gateway expects a reply for twice as long
SLOW = 0.3  # seconds; an echo takes none of them
SILENT = 2.1  # seconds since the last reply: an echo may have begun meanwhile


@dataclass
class Forward(Slave):
    """Replies to a broadcast, so late that the next write is on its way. `refuses` that write."""

    refuses: bool = False
    owed: bytes = b""
    heard: float = 0.0  # when the broadcast was
    told: int = 0  # late replies

    def _replies(self, request: bytes) -> Sequence[bytes]:
        if request[1] != WRITE_WORDS:
            return super()._replies(request)
        done = bytes((1, *request[1:6]))
        done += crc(done)
        if request[0] == 0:
            self.owed, self.heard = done, monotonic()
            return ()
        # Later it would be no late reply: then a busy machine was late with the write.
        late = [self.owed] * (bool(self.owed) and monotonic() - self.heard < LATEST)
        self.owed = b""
        self.told += len(late)
        refusal = bytes((1, 0x80 | WRITE_WORDS, 4))
        return *late, refusal + crc(refusal) if self.refuses else done


def is_good(sample: Received) -> bool:
    return bool(sample.json["quality"] == "good")


async def test_a_late_reply_to_a_broadcast_acknowledges_no_write(tmp_path: Path) -> None:
    """Each write was refused, and told as done."""
    slave = Forward(lambda n: n < 10, delay=0.02, refuses=True)
    speed = {"address": "holding:4", "type": "uint32", "write": True}
    timing = {"protocol": "modbus-rtu", "reply_timeout": "500ms"}
    devices: dict[str, Any] = {
        "all": {**timing, "station": 0, "tags": {"speed": speed}},
        "pump": {**timing, "station": 1, "tags": {"speed": {**speed, "every": "10s"}}},
    }
    async with program_on(slave, tmp_path, devices) as (_, client):
        values = await client.subscribe("plant/pump/speed")
        await values.next(is_good)
        while slave.told < 2:
            before = slave.told
            [sent] = await client.get("plant/all/speed/@set", b"7")
            assert sent.ok
            [answer] = await client.get("plant/pump/speed/@set", b"9")
            assert not answer.ok
            assert answer.json["error"] == ("unclear" if slave.told > before else "refused")
        slave.refuses = False
        [answer] = await client.get("plant/pump/speed/@set", b"9")
        assert answer.ok, answer.json


@dataclass
class Looping(Drive):
    """`quick`: only its replies take time, not the echo."""

    quick: bool = False
    asked: float = 0.0  # when it was

    def _replies(self, request: bytes) -> Sequence[bytes]:
        self.asked = monotonic()
        replies = super()._replies(request)
        self.delay = 0.0 if self.quick and self._off else SLOW
        return replies


async def test_an_echo_that_begins_later_acknowledges_no_write(tmp_path: Path) -> None:
    """It comes sooner than the drive ever replied, or after a silence. Both at once: they wait."""
    await asyncio.gather(_no_false_write(tmp_path, quick=True), _no_false_write(tmp_path))


async def _no_false_write(folder: Path, *, quick: bool = False) -> None:
    drive = Looping(lambda n: n in (10, 11), quick=quick)
    tags: dict[str, Any] = {
        "a": {"address": "holding:10"},
        "b": {"address": "holding:11", "write": True},
    }
    every = "100ms" if quick else "10s"
    tags = {name: {**tag, "every": every} for name, tag in tags.items()}
    device: dict[str, Any] = {"protocol": "modbus-rtu", "station": 1, "tags": tags, "retries": 0}
    device |= {"reply_timeout": "1s", "late_guard": "50ms"}
    folder /= every
    folder.mkdir()
    async with program_on(drive, folder, {"drive": device}) as (program, client):
        values = await client.subscribe("plant/drive/b")
        await values.next(is_good)
        [answer] = await client.get("plant/drive/b/@set", b"11")
        assert answer.ok, answer.json
        while not quick and (left := drive.asked + SLOW + SILENT - monotonic()) > 0:
            await asyncio.sleep(left)
        drive.echoes = True
        [answer] = await client.get("plant/drive/b/@set", b"12")
        assert drive._off
        assert not answer.ok
        assert answer.json["error"] == "unclear"
        if quick:
            drive.echoes = False
            await asyncio.to_thread(program.says, "device offline")
            values.forget()
            await values.next(is_good)
            [answer] = await client.get("plant/drive/b/@set", b"13")
            assert answer.ok, answer.json
    assert drive.held == {11: 13 if quick else 11}
