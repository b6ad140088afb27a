"""Blocks that nobody had asked for: counted, and told as the driver that knows them puts it."""

import asyncio
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import structlog

from gateway.engine.device import Device
from gateway.errors import Garbled
from gateway.protocols.driver import Codec, StrayFrames

log = structlog.get_logger("gateway.line")
TELL_EVERY = 10.0  # seconds for each device; what comes between is told to debuggers only
PAUSE = 0.1  # seconds without a byte after which a block begins anew


@dataclass(slots=True)
class Overheard:
    """What is heard on one line while nothing was asked, or beside the answer.

    A list registered in a PLC counts as forgotten then: perhaps somebody else spoke to it.
    """

    line: str
    devices: Sequence[Device]
    _codecs: dict[Device, Codec[Any]] = field(default_factory=dict)
    _last: float = float("-inf")
    _told: dict[Device, float] = field(default_factory=dict)

    def idle(self, data: bytes) -> None:
        """Bytes that came while nothing was asked."""
        now = _now()
        if now - self._last > PAUSE:
            self._codecs.clear()
        self._last = now
        for device in self.devices:
            device.registered = ()
            if isinstance(device.driver, StrayFrames):
                heard = self._feed(device, data)
                frames = [frame for frame in heard if device.driver.from_this_station(frame)]
                device.record.unasked += len(frames)
                self.frames(device, frames)

    def frames(self, device: Device, frames: Iterable[Any]) -> None:
        """Whole ones that answered nothing, already counted."""
        for frame in frames:
            device.registered = ()
            if not isinstance(device.driver, StrayFrames):
                continue
            if said := device.driver.describe_stray(frame):
                self._tell(device, said)

    def _feed(self, device: Device, data: bytes) -> list[Any]:
        codec = self._codecs.setdefault(device, device.driver.codec())
        try:
            return codec.feed(data)
        except Garbled:
            del self._codecs[device]
            return []

    def _tell(self, device: Device, said: str) -> None:
        now = _now()
        due = now - self._told.get(device, float("-inf")) >= TELL_EVERY
        if due:
            self._told[device] = now
        (log.info if due else log.debug)(
            "nobody asked for this",
            line=self.line,
            device=device.name,
            what=said,
            count=device.record.unasked,
        )


def _now() -> float:
    return asyncio.get_running_loop().time()
