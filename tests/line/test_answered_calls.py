"""A served line with a modem: it answers calls, and each call is another master's."""

import asyncio
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from gateway.config import LineConfig, built
from gateway.errors import LineDown
from gateway.parts.serving.part import served_documents
from gateway.parts.serving.served_line import ServedLine
from gateway.stations.served.station import ServedStation
from gateway.tags import Quality, Sample
from gateway.transport import ModemAddress, Port, PortAddress, Receiver, SerialSettings, open_modem
from tests.line.telephone import Cable, now, running
from tests.serving.easy_link import frame
from tests.sim.virtual import on_virtual_time
from tests.transport.modem import ModemModel

WRITE = frame(1, "61", "1C0002FA00")  # D0 = 250
READ = frame(1, "51", "1C0002")


def center(**device: Any) -> LineConfig:
    station = {
        "protocol": "vigor",
        "station": 1,
        "accept": ["D0"],
        "tags": {"level": {"address": "D0"}},
        **device,
    }
    line = {
        "port": "modem:/dev/ttyS0",
        "serve": True,
        "modem": {"guard": "100ms"},
        "devices": {"vr1": station},
    }
    [config] = built({"lines": {"center": line}}, Path()).lines
    return config


class Caller:
    """The other end of the telephone line, and what becomes of the values."""

    def __init__(self, config: LineConfig) -> None:
        self.replies = b""
        self.model = ModemModel(answers=self._heard, guard=0.1)
        self.now: list[Sample] = []
        self.present: list[bool] = []
        self.cable: Cable | None = None
        self.line = ServedLine(config, self, lambda row: None, open_port=self._open)

    async def _open(self, receiver: Receiver) -> Port:
        config = self.line.config
        assert isinstance(config.port, ModemAddress)
        assert config.modem is not None
        return await open_modem(
            *(config.port, config.serial, config.modem, receiver), answers=True, opens=self._below
        )

    async def _below(self, _: PortAddress, __: SerialSettings, receiver: Receiver) -> Port:
        self.cable = Cable(self.model, receiver)
        return self.cable

    def _heard(self, data: bytes) -> bytes:
        self.replies += data
        return b""

    async def call(self) -> None:
        self.say(self.model.ring())
        await asyncio.sleep(1)
        assert self.model.online

    def say(self, data: bytes) -> None:
        assert self.cable is not None
        self.cable.say(data)

    async def ask(self, data: bytes) -> bytes:
        self.replies = b""
        self.say(data)
        await asyncio.sleep(0.5)
        return self.replies

    # The sample sink

    def samples(self, samples: Sequence[Sample]) -> None:
        self.now += samples

    def online(self, device: ServedStation, online: bool) -> None:
        self.present.append(online)


@asynccontextmanager
async def ready(caller: Caller) -> AsyncIterator[Caller]:
    async with running(caller):
        await asyncio.sleep(5)
        yield caller


@on_virtual_time
async def test_each_call_is_answered_and_the_values_stay_between_them() -> None:
    async with ready(Caller(center())) as caller:
        for _ in range(2):
            await caller.call()
            assert b"6100" in await caller.ask(WRITE)
            caller.say(caller.model.drop())
            await asyncio.sleep(3600)
        values = [(sample.value, sample.quality) for sample in caller.now]
        assert values == [(250, Quality.GOOD)] * 2
        assert caller.present == [True, False] * 2
        assert caller.model.commands.count("ATA") == 2


@on_virtual_time
async def test_the_status_counts_answered_calls() -> None:
    async with ready(Caller(center())) as caller:

        def shown() -> Any:
            documents: Any = served_documents([caller.line], now())
            assert documents["lines/center"]["served"]
            assert documents["devices/vr1"]["stale_after"] is None  # the values stay
            return documents["lines/center"]["calls"]

        quiet = shown()
        assert (quiet["state"], quiet["since"], quiet["next"]) == ("idle", None, None)
        await caller.call()
        lasts = shown()
        assert (lasts["state"], lasts["made"], lasts["last_result"]) == ("connected", 1, "")
        assert 0 < lasts["since"] < 2
        caller.say(caller.model.drop())
        await asyncio.sleep(60)
        ended = shown()
        assert (ended["state"], ended["failed"], ended["last_result"]) == ("idle", 0, "complete")
        await caller.call()
        assert caller.cable is not None
        caller.cable.receiver.lost(LineDown("unplugged"))
        await asyncio.sleep(0.05)
        lost = shown()
        assert (lost["state"], lost["made"], lost["failed"]) == ("idle", 2, 1)
        assert lost["last_result"] == "modem lost"
        caller.model.online = False
        await asyncio.sleep(10)


@on_virtual_time
async def test_stale_after_counts_from_the_last_request() -> None:
    async with ready(Caller(center(stale_after="1d"))) as caller:
        await caller.call()
        await caller.ask(WRITE)
        caller.say(caller.model.drop())
        await asyncio.sleep(86_000)
        assert [sample.quality for sample in caller.now] == [Quality.GOOD]
        await asyncio.sleep(1_000)
        assert [sample.quality for sample in caller.now] == [Quality.GOOD, Quality.BAD]


@on_virtual_time
async def test_a_silent_master_and_a_lost_wire_are_reported() -> None:
    async with ready(Caller(center(stale_after="10s"))) as caller:
        await caller.call()
        await caller.ask(WRITE)
        await asyncio.sleep(11)
        assert caller.present == [True, False]
        await caller.ask(WRITE)
        assert caller.cable is not None
        caller.cable.receiver.lost(LineDown("unplugged"))
        await asyncio.sleep(0.05)
        assert caller.present == [True, False] * 2
        caller.model.online = False
        await asyncio.sleep(10)


@on_virtual_time
async def test_a_frame_that_one_call_begins_is_not_ended_by_the_next() -> None:
    async with ready(Caller(center())) as caller:
        await caller.call()
        assert await caller.ask(WRITE[:8]) == b""
        caller.say(caller.model.drop())
        await asyncio.sleep(20)
        await caller.call()
        assert await caller.ask(WRITE[8:]) == b""
        assert caller.now == []
        assert caller.model.commands[-1] == "ATA"  # nothing was said between the calls


@on_virtual_time
async def test_a_reply_that_waits_is_not_sent_after_the_call() -> None:
    async with ready(Caller(center(turnaround="200ms"))) as caller:
        await caller.call()
        caller.say(READ)
        await asyncio.sleep(0.05)
        caller.say(caller.model.drop())
        caller.say(caller.model.connect())  # a modem that answers by itself, at once
        await asyncio.sleep(1)
        assert caller.replies == b""


@on_virtual_time
async def test_a_caller_who_says_nothing_is_hung_up_after_a_minute() -> None:
    async with ready(Caller(center())) as caller:
        await caller.call()
        await asyncio.sleep(58)
        assert caller.model.online
        await asyncio.sleep(5)
        assert not caller.model.online
        await caller.call()
        assert b"6100" in await caller.ask(WRITE)
