"""What people want of a device: writes and commands, on their way down the line."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from gateway.engine.device import Device
from gateway.errors import GatewayError
from gateway.tags import Tag, WriteResult

Done = Callable[[WriteResult | GatewayError], None]
Told = Callable[[str | GatewayError], None]


@dataclass(slots=True, eq=False)
class Write:
    """A value for a tag; `done` is called exactly once. Times by the loop's clock."""

    device: Device
    tag: Tag
    units: Sequence[int]
    submitted: float
    expires: float  # not sent any more after this: whoever asked has given up
    done: Done
    alone: bool = False  # it was refused together with others

    @property
    def plain(self) -> bool:
        """One exchange and no more: it may share that exchange with others."""
        rule = self.tag.write
        conversation = rule is not None and (rule.verify or rule.repeat)
        return not (self.alone or conversation) and self.tag.address.bit is None

    @property
    def latest(self) -> bool:
        """Of several that wait, only the last is to be sent."""
        return self.tag.write is not None and self.tag.write.latest


class CommandResult(NamedTuple):
    """What a device said to a command; `time` in ns since 1970, `took` in seconds."""

    answer: str
    time: int
    took: float


@dataclass(slots=True, eq=False)
class Command:
    """Run, stop, loopback, model ...; `done` is called exactly once."""

    device: Device
    name: str
    argument: str
    submitted: float
    expires: float
    done: Told


Order = Write | Command


WAITING_ORDERS = 1000


class OrderQueue:
    """The orders of one line that wait. What a device is told stays in the order it was asked."""

    def __init__(self) -> None:
        self._orders: deque[Order] = deque()

    def __len__(self) -> int:
        return len(self._orders)

    @property
    def first(self) -> Order:
        return self._orders[0]

    def undoubted(self) -> Order | None:
        """Takes out the first to a device that is not in doubt."""
        for order in self._orders:
            if not order.device.doubtful:
                self._orders.remove(order)
                return order
        return None

    def submit(self, order: Order) -> bool:
        """False when too many orders wait already."""
        if len(self._orders) >= WAITING_ORDERS:
            return False
        self._orders.append(order)
        return True

    def superseded(self, write: Write) -> list[Order]:
        """The waiting writes that need not be sent, as `write` follows: its tag says `latest`."""
        if not write.latest:
            return []
        return self._out(lambda other: isinstance(other, Write) and other.tag is write.tag)

    def companions(self, write: Write, fit: Callable[[Sequence[Write]], bool]) -> list[Write]:
        """The next orders of its device as far as all can go out with it; they are taken out."""
        found: list[Write] = []
        for order in self._orders:
            if order.device is not write.device:
                continue
            if not isinstance(order, Write) or not fit([write, *found, order]):
                break
            found.append(order)
        if found:
            self._out(lambda order: order in found)
        return found

    def each_alone(self, writes: Sequence[Write]) -> None:
        """They were refused together, so nothing of them was done: they are next, one by one."""
        for write in reversed(writes):
            write.alone = True
            self._orders.appendleft(write)

    def withdraw(self, device: Device | None = None) -> list[Order]:
        """The waiting orders (to one device) that will not be sent any more."""
        return self._out(lambda order: device is None or order.device is device)

    def expired(self, now: float) -> list[Order]:
        """The waiting orders nobody waits for any longer; they are forgotten here."""
        return self._out(lambda order: order.expires <= now) if self._orders else []

    def _out(self, which: Callable[[Order], bool]) -> list[Order]:
        taken = [order for order in self._orders if which(order)]
        if taken:
            self._orders = deque(order for order in self._orders if not which(order))
        return taken
