"""Effects of a result, as plain data: samples, state changes, outcomes, pauses and log events."""

from collections.abc import Sequence
from typing import NamedTuple

from gateway.engine.device.device import Device
from gateway.engine.jobs.requests import Outcome, Request, unsent
from gateway.errors import GatewayError
from gateway.tags import Reason, Sample, Tag, bad


class Samples(NamedTuple):
    """New samples, read together."""

    samples: Sequence[Sample]


class OnlineChange(NamedTuple):
    """A device came online, or went offline."""

    device: Device
    online: bool


class RequestEnded(NamedTuple):
    """The outcome of a request; each request has exactly one."""

    request: Request
    outcome: Outcome


class Pause(NamedTuple):
    """The line is silent for so many seconds, while stations process a broadcast."""

    seconds: float


class LogEvent(NamedTuple):
    """An event for the log: `noun verb` and its fields."""

    level: str  # debug, info, warning
    event: str
    fields: dict[str, object]


Effect = Samples | OnlineChange | RequestEnded | Pause | LogEvent


class Effects:
    """Collects the effects of one call of the engine, in their order."""

    __slots__ = ("collected",)

    def __init__(self) -> None:
        self.collected: list[Effect] = []

    def take(self) -> list[Effect]:
        """Returns all effects since the last call."""
        collected, self.collected = self.collected, []
        return collected

    def samples(self, samples: Sequence[Sample]) -> None:
        self.collected.append(Samples(samples))

    def bad(self, tags: Sequence[Tag], reason: Reason, time: int, detail: str) -> None:
        """Turns the tags bad at `time` (ns since 1970)."""
        self.collected.append(Samples([bad(tag, reason, time, detail) for tag in tags]))

    def online(self, device: Device, online: bool) -> None:
        self.collected.append(OnlineChange(device, online))

    def unsent(self, request: Request, why: GatewayError) -> None:
        """Ends a request that is not sent."""
        self.collected.append(RequestEnded(request, unsent(request, why)))

    def pause(self, seconds: float) -> None:
        self.collected.append(Pause(seconds))

    def debug(self, event: str, **fields: object) -> None:
        self.collected.append(LogEvent("debug", event, fields))

    def info(self, event: str, **fields: object) -> None:
        self.collected.append(LogEvent("info", event, fields))

    def warning(self, event: str, **fields: object) -> None:
        self.collected.append(LogEvent("warning", event, fields))
