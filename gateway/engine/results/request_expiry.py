"""Request expiry: ends requests that waited too long for the line."""

from gateway.engine.effects import Effects
from gateway.engine.jobs.request_queue import RequestQueue
from gateway.engine.results.rule import NEVER, Rule
from gateway.errors import Busy


class RequestExpiry(Rule):
    """A client waits only so long: what it no longer waits for is not sent."""

    def __init__(self, requests: RequestQueue, effects: Effects) -> None:
        self._requests = requests
        self._effects = effects

    @property
    def due(self) -> float:
        return min((request.expires for request in self._requests.waiting), default=NEVER)

    def tick(self, now: float, time: int) -> None:
        for request in self._requests.expired(now):
            waited = now - request.submitted
            self._effects.unsent(request, Busy(f"waited {waited:.1f} s for the line; not sent"))
