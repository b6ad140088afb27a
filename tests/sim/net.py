"""A TCP connection to Modbus TCP units: nothing is lost or damaged, but it may stall or break.

Both directions work at once and keep the order. Bytes on their way in a stall arrive after it.
"""

import asyncio
import random
from collections import deque
from collections.abc import Callable, Mapping
from contextvars import copy_context
from dataclasses import dataclass, field

from gateway.errors import LineDown
from gateway.transport import Receiver
from tests.sim.noise import Noise
from tests.sim.stations import Troubled
from tests.sim.wire import Watch

HOP = 0.0004  # seconds from one end to the other


@dataclass(eq=False)
class SimNet:
    """The opener of a connection, and the units behind it, by number."""

    units: Mapping[int, Troubled]
    chance: random.Random
    watch: Watch
    split: bool = False  # answers arrive in two pieces
    noise: Noise = field(default_factory=Noise)  # none by default
    gone: str = ""
    hung: bool = False  # no byte passes until the connection is opened again
    bridge: float = 0.0  # seconds that a bridge to serial units waits for a reply; 0: no bridge
    opened: int = 0
    closed: int = 0

    def __post_init__(self) -> None:
        self._ear: Receiver | None = None
        self._generation = 0
        self._hanging = False
        self._stuck: list[Callable[[], None]] = []
        self._context = copy_context()  # the world's, also where the gateway sends
        self._waiting: deque[tuple[bytes, int]] = deque()  # requests in the bridge

    # The port

    async def open(self, ear: Receiver) -> "SimNet":
        if self.hung:
            self.hung, self._hanging = False, False
        if self.gone or self._hanging:
            raise LineDown(self.gone or "no answer within 5 s")
        self._ear = ear
        self._generation += 1
        self.opened += 1
        return self

    def write(self, data: bytes) -> None:
        if self._ear is None:
            raise LineDown(self.gone or "closed")
        now = _now()
        self.watch.sent(data, now, now)
        self._pass(HOP, lambda: self._arrive(data))

    async def close(self) -> None:
        self.closed += 1
        self._end()

    def vanish(self, why: str) -> None:
        self.gone = why
        self._reset(why)

    def come_back(self) -> None:
        self.gone = ""

    @property
    def hanging(self) -> bool:
        return self._hanging

    @hanging.setter
    def hanging(self, hanging: bool) -> None:
        self._hanging = hanging
        if not hanging:
            stuck, self._stuck = self._stuck, []
            for deliver in stuck:
                deliver()

    # The network

    def _end(self) -> None:
        self._ear = None
        self._generation += 1
        self._stuck.clear()

    def _reset(self, why: str) -> None:
        ear = self._ear
        self._end()
        if ear is not None:
            ear.lost(LineDown(why))

    def _arrive(self, data: bytes) -> None:
        self.watch.passed(">", data)
        if not self.bridge:
            self._ask(data, self.units.get(data[6]))
            return
        self._waiting.append((data, self._generation))
        if len(self._waiting) == 1:
            self._ask_next()

    def _ask(self, data: bytes, unit: Troubled | None) -> float | None:
        """Passes the request on. Returns the seconds until the reply ended, or None."""
        said = None if unit is None else unit.hear(data, _now())
        if unit is None or said is None:
            return None
        reply, delay = said
        if unit.broke_off:
            self._pass(delay, lambda: self._break_off(reply))
        else:
            self._pass(delay + HOP, lambda: self._deliver(reply))
        for after, _ in unit.copies():
            self._pass(delay + HOP + after, lambda: self._deliver(reply))
        return delay

    # A bridge asks one serial unit at a time, and waits for each reply with its own time-out

    def _ask_next(self) -> None:
        data, generation = self._waiting[0]
        took = self._ask(data, self.units.get(data[6])) if generation == self._generation else 0.0
        wait = self.bridge if took is None else took
        asyncio.get_running_loop().call_later(
            wait, self._bridged, data, took is None, context=self._context
        )

    def _bridged(self, data: bytes, silent: bool) -> None:
        _, generation = self._waiting.popleft()
        if silent and generation == self._generation:
            self._pass(HOP, lambda: self._deliver(no_reply(data)))
        if self._waiting:
            self._ask_next()

    def _break_off(self, reply: bytes) -> None:
        self._deliver(reply)
        self._reset("connection reset by peer")

    def _deliver(self, data: bytes) -> None:
        cut = self.chance.randrange(len(data)) if self.split else 0
        self.watch.passed("<", data)
        for piece in (data[:cut], data[cut:]):
            if piece and self._ear is not None:
                self._ear.received(piece)

    def _pass(self, after: float, then: Callable[[], None]) -> None:
        generation = self._generation

        def unless_closed() -> None:
            if generation != self._generation:
                return
            if self._hanging:
                self._stuck.append(unless_closed)
            else:
                then()

        asyncio.get_running_loop().call_later(after, unless_closed, context=self._context)


def no_reply(request: bytes) -> bytes:
    """Returns exception 0B: the unit behind the bridge did not reply."""
    return request[:4] + b"\x00\x03" + bytes((request[6], request[7] | 0x80, 0x0B))


def _now() -> float:
    return asyncio.get_running_loop().time()
