"""A line with a modem, on a virtual clock: the gateway's own modem port, and a model of a modem."""

import asyncio
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any, Protocol, TypeVar

from gateway.config import built
from gateway.engine.device.device import Device
from gateway.engine.jobs.requests import WRITE_EXPIRY
from gateway.line.calling import ModemOpener
from gateway.plant.build import line_of
from gateway.stations.vigor import VigorStation
from gateway.tags import Sample, Tag, WriteResult
from gateway.transport import ModemAddress, Port, PortAddress, Receiver, SerialSettings
from tests.transport.modem import ModemModel

TAGS: dict[str, Any] = {
    "level": {"address": "D100", "every": "15min"},
    "limit": {"address": "D200", "every": "15min", "write": True},
}


class Cable:
    """The port of a model: what it says arrives a millisecond later."""

    def __init__(self, model: ModemModel, receiver: Receiver) -> None:
        self._model = model
        self.receiver = receiver
        self._timer: asyncio.TimerHandle | None = None
        self._open = True

    def write(self, data: bytes) -> None:
        self.say(self._model.feed(data, now()))

    def say(self, data: bytes) -> None:
        if data:
            asyncio.get_running_loop().call_later(0.001, self._arrive, data)
        if self._timer is not None:
            self._timer.cancel()
        if self._model.due < 1e8:
            loop = asyncio.get_running_loop()
            self._timer = loop.call_at(self._model.due, self._tick)

    async def close(self) -> None:
        self._open = False
        if self._timer is not None:
            self._timer.cancel()

    def _tick(self) -> None:
        self.say(self._model.tick(now()))

    def _arrive(self, data: bytes) -> None:
        if self._open:
            self.receiver.received(data)


class Telephone:
    """A line to one Vigor PLC behind a modem, and what becomes of its values and writes."""

    def __init__(self, model: ModemModel, tags: dict[str, Any] | None = None, **modem: Any) -> None:
        self.model = model
        model.answers = self.answer
        self.plc = VigorStation(1)
        self.plc.memory.write("D", 100, [17])
        self.cuts: list[bool] = []  # for each reply: the line breaks in the middle of it
        self.now: dict[str, Sample] = {}
        self._cable: Cable | None = None
        mixer = {"protocol": "vigor", "station": 1, "tags": tags or TAGS}
        settings = {"number": "26204393", "guard": "100ms", **modem}
        line = {"port": "modem:/dev/ttyS0", "modem": settings, "devices": {"mixer": mixer}}
        [config] = built({"lines": {"far": line}}, Path()).lines
        assert isinstance(config.port, ModemAddress)
        assert config.modem is not None
        opener = ModemOpener(config.port, config.serial, config.modem, self._open)
        self.line = line_of(config, config.devices, self, open_port=opener, wall=lambda: 1)
        [self.device] = self.line.engine.devices

    async def _open(self, _where: PortAddress, _how: SerialSettings, receiver: Receiver) -> Port:
        self._cable = Cable(self.model, receiver)
        return self._cable

    def answer(self, data: bytes) -> bytes:
        """The station; its reply may be cut in the middle."""
        reply = b"".join(self.plc.hear(data, now()))
        if reply and self.cuts and self.cuts.pop(0):
            return reply[: len(reply) // 2] + self.model.drop()
        return reply

    def say(self, data: bytes) -> None:
        """The modem says something by itself."""
        assert self._cable is not None
        self._cable.say(data)

    @property
    def dials(self) -> int:
        return sum(command.startswith("ATD") for command in self.model.commands)

    # The sample sink

    def samples(self, samples: Sequence[Sample]) -> None:
        self.now |= {sample.tag.name: sample for sample in samples}

    def online(self, device: Device, online: bool) -> None:
        """The samples say all that counts here."""

    # Clients

    def tag(self, name: str) -> Tag:
        return next(tag for tag in self.device.tags if tag.name == name)

    def write(self, value: int) -> "asyncio.Future[WriteResult]":
        tag = self.tag("limit")
        within = WRITE_EXPIRY + self.line.dialling  # as northbound gives its clients
        return self.line.write(self.device, tag, tag.encode(value), within)


class WithLine(Protocol):
    """A line and what surrounds it."""

    @property
    def line(self) -> Any: ...


W = TypeVar("W", bound=WithLine)


@asynccontextmanager
async def running(around: W) -> AsyncIterator[W]:
    """The line, until the end of the block."""
    task = asyncio.create_task(around.line.run())
    try:
        yield around
        assert not task.done()
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task


def now() -> float:
    return asyncio.get_running_loop().time()
