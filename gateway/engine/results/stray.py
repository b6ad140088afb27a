"""Stray frames: counted, explained in the log by the driver, and taken as extra replies."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, cast

from gateway.engine.device.changes import Changes
from gateway.engine.device.device import Device
from gateway.engine.effects import Effects
from gateway.engine.results.health_rules import HealthRules
from gateway.engine.results.listening import listens
from gateway.engine.results.rule import Rule
from gateway.errors import Garbled
from gateway.protocols.capabilities import BehindGateway, StrayFrames, UnnumberedReplies
from gateway.protocols.driver import Codec

LOG_EVERY = 10.0  # seconds for each device; other frames are logged at level debug
PAUSE = 0.1  # seconds without a byte after which a frame begins


class Stray(Rule):
    """Counts and logs frames of one line that are no reply to any request.

    Another master may have sent them and changed the monitor list of a PLC. So the line registers
    the list again.
    """

    def __init__(
        self,
        line: str,
        devices: Sequence[Device],
        results: HealthRules,
        effects: Effects,
        replied: Callable[[], None] = lambda: None,
    ) -> None:
        """`replied` is called for each reply that arrives outside of a transaction."""
        self._line = line
        self._devices = devices
        self._results = results
        self._effects = effects
        self._replied = replied
        self._readers = _readers(devices)
        self._codecs: dict[object, Codec[Any]] = {}
        self._last = float("-inf")
        self._logged: dict[Device, float] = {}

    def applies(self, devices: Sequence[Device]) -> bool:
        return not listens(devices)  # the frames there are those of another master

    def change(self, changes: Changes, now: float, *, is_open: bool) -> None:
        """Takes over changed devices of the line, which are in `devices` already."""
        self._readers = _readers(self._devices)
        for device in changes.left:
            self._logged.pop(device, None)

    def received(self, data: bytes, now: float, time: int) -> None:
        """Takes bytes that arrived outside of a transaction."""
        if now - self._last > PAUSE:
            self._codecs.clear()
        self._last = now
        for device in self._devices:
            device.monitor.forget()
        for kind, devices in self._readers.items():
            found = self._feed(kind, devices[0], data)
            for device in devices if found else ():
                station = device.driver.station
                own = [frame for frame in found if frame.station == station]
                device.record.count_stray(len(own))
                self._log_frames(device, own, now)
                self._count_older(device, own, now)
                extra = _note_extra_replies(device, own, now)
                if extra or (own and device.driver.traits.over_network):
                    self._replied()
                if extra:
                    self._results.spoke(device, now)
                    self._results.answered_twice(device, now, time)

    def unmatched(self, device: Device, frame: Any, now: float, time: int, *, echo: bool) -> None:
        """Takes a frame that arrived in a transaction with this device and is not its reply."""
        device.record.count_stray()
        device.monitor.forget()
        self._log_frames(device, [frame], now)
        for each in self._devices:
            if each.driver.traits.over_network and each.driver.station == frame.station:
                self._count_older(each, [frame], now)
        for each in self._devices:
            if not echo and _note_extra_replies(each, [frame], now):
                self._results.spoke(each, now)
                self._results.answered_twice(each, now, time)

    def _count_older(self, device: Device, frames: Sequence[Any], now: float) -> None:
        """A bridge or device server works through the requests that it has kept."""
        driver, others = device.driver, len(self._devices) > 1
        for frame in frames if driver.traits.over_network else ():
            absent = others and isinstance(driver, BehindGateway) and driver.is_absence(frame)
            device.health.replied_to_older(now, absent=absent)

    def _log_frames(self, device: Device, frames: Iterable[Any], now: float) -> None:
        """Logs complete frames that are already counted."""
        driver = device.driver
        if not isinstance(driver, StrayFrames):
            return
        for frame in frames:
            if text := driver.describe_stray(frame):
                self._log(device, text, now)

    def _feed(self, kind: object, device: Device, data: bytes) -> list[Any]:
        codec = self._codecs.get(kind)
        if codec is None:
            codec = self._codecs[kind] = device.driver.codec()
        try:
            return codec.feed(data)
        except Garbled:
            del self._codecs[kind]
            return []

    def _log(self, device: Device, text: str, now: float) -> None:
        due = now - self._logged.get(device, float("-inf")) >= LOG_EVERY
        if due:
            self._logged[device] = now
        log = self._effects.info if due else self._effects.debug
        count = device.record.unasked
        log("stray frame", line=self._line, device=device.name, what=text, count=count)


def _readers(devices: Sequence[Device]) -> dict[object, list[Device]]:
    """Returns the devices whose frames are read, by their codecs: equal ones read bytes once."""
    readers: dict[object, list[Device]] = {}
    for device in devices:
        readable = isinstance(device.driver, StrayFrames) or device.driver.traits.over_network
        if device.shapes is not None or readable:
            readers.setdefault(_kind(device.driver.codec()), []).append(device)
    return readers


def _note_extra_replies(device: Device, frames: Sequence[Any], now: float) -> bool:
    """Notes the replies of the device, where replies have no number. Returns True if one is."""
    shapes = device.shapes
    if shapes is None:
        return False
    replies = [f for f in frames if cast("UnnumberedReplies", device.driver).is_reply(f)]
    for frame in replies:
        shapes.proofs.twins.arrived(frame, now)
    return bool(replies)


def _kind(codec: Codec[Any]) -> object:
    """Returns the same for fresh codecs that read the same frames."""
    return type(codec), str(vars(codec))
