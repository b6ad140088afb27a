"""What people want of a device: writes and commands, on their way down the line."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from gateway.device import Device
from gateway.errors import GatewayError
from gateway.tags import Tag, Written

Done = Callable[[Written | GatewayError], None]
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


class Obeyed(NamedTuple):
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
