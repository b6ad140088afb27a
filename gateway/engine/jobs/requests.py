"""Requests of clients: writes and commands, and their outcomes."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from gateway.engine.device.device import Device
from gateway.engine.device.long_writes import LongWrite, long_write, writes_around
from gateway.errors import GatewayError, NotSent, Refused
from gateway.protocols.capabilities import Controllable
from gateway.protocols.driver import AnyDriver, Span
from gateway.tags import Tag, WriteResult
from gateway.tags.decoding import WordPart
from gateway.tags.tag import OriginWord
from gateway.values import Value

WRITE_EXPIRY = 5.0  # seconds after which a waiting request is no longer sent
MOST_WAITING = 1000  # writes and commands
RACE = "other bits of its word that the device changed at this moment may be as before"
MOST_PEEKS = 16  # any client that may read can send them


class Peeked(NamedTuple):
    """Words or bits as they were read; `time` in ns since 1970, `took` in seconds."""

    address: str
    units: list[int]
    time: int
    took: float


class CommandResult(NamedTuple):
    """The reply of a device to a command; `time` in ns since 1970, `took` in seconds."""

    answer: str
    time: int
    took: float


Outcome = WriteResult | str | GatewayError


class Resyncs(NamedTuple):
    """Tokens of the resyncs around a request whose reply could be an extra reply; None: none."""

    before: int | None = None
    after: int | None = None


NO_RESYNCS = Resyncs()


@dataclass(slots=True, eq=False)
class Group:
    """Writes of one client to one device. They are sent in their order; after the first that is
    not done none is sent."""

    failed: str = ""  # the tag of the first that was not done

    def fail(self, tag: Tag) -> None:
        """Notes a write that was not done."""
        self.failed = self.failed or tag.name


@dataclass(slots=True, eq=False)
class Write:
    """A value for a tag. Times in seconds of the line's clock."""

    device: Device
    tag: Tag
    units: Sequence[int]
    submitted: float
    within: float = WRITE_EXPIRY
    refused: Refused | None = None  # before it was done, sent otherwise: now it is sent alone
    resyncs: Resyncs = NO_RESYNCS
    group: Group | None = None
    masked: bool = False  # the device changes the bits of its word by itself
    part: WordPart | None = field(init=False)  # of its word, which it changes; None: whole words
    origin: OriginWord | None = field(init=False)  # of its values, as users see it
    races: bool = field(init=False)  # bits around it are written as they were read
    value: Value = field(init=False)  # as the device will hold it, rounded to its steps
    long: LongWrite | None = field(init=False, default=None)  # None: one request is enough

    def __post_init__(self) -> None:
        self.part, self.origin = self.tag.part, self.tag.origin.word
        self.races = self.part is not None or writes_around(self.device.driver, self.tag.span)
        value = self.tag.from_units(self.units)
        self.value = False if value is None else value
        if self.tag.span.size > 1:
            elements = len(value) if isinstance(value, tuple) else 0
            self.long = long_write(self.device.driver, self.tag.span, elements)

    @property
    def expires(self) -> float:
        """The time after which it is not sent, because the client no longer waits."""
        return self.submitted + self.within

    def send_alone(self, refused: Refused) -> None:
        """Notes a refusal before it was done: together with others, or by its bits."""
        self.refused = refused

    def mask(self, *, masked: bool) -> None:
        """Has the device change the bits of the word by itself, or not."""
        self.masked, self.races = masked, not masked

    @property
    def plain(self) -> bool:
        """True if one request is enough, which it can share with other writes."""
        rule = self.tag.write
        needs_more = rule is not None and (rule.verify or rule.repeat)
        return not (self.refused or needs_more) and self.part is None

    @property
    def latest(self) -> bool:
        """True if only the last of several waiting writes is sent. In a group each is sent."""
        return self.group is None and self.tag.write is not None and self.tag.write.latest

    def holds(self, units: Sequence[int]) -> bool:
        """Returns True if `units`, as read back, are the written value."""
        if self.tag.origin.shape is not None:  # bytes are written, a value is read
            return self.tag.decode(units) == self.tag.from_units(self.units)
        if self.part is not None:
            return self.part.of(units[0]) == self.units[0]
        return list(units) == list(self.units)


@dataclass(slots=True, eq=False)
class Command:
    """A command to one device: run, stop, loopback, model and others; or a peek at addresses."""

    device: Device
    name: str
    argument: str
    submitted: float
    within: float = WRITE_EXPIRY
    span: Span | None = None  # of a peek: it is read, and nothing changes
    resyncs: Resyncs = NO_RESYNCS

    def resync(self, before: int) -> None:
        """Has a resync with this token sent before it."""
        self.resyncs = Resyncs(before)

    @property
    def broadcast(self) -> bool:
        """True if it goes to all stations, and none replies."""
        driver = self.device.driver
        return isinstance(driver, Controllable) and self.name in driver.broadcast_commands

    @property
    def expires(self) -> float:
        """The time after which it is not sent, because the client no longer waits."""
        return self.submitted + self.within


Request = Write | Command


def after_failed(write: Write, group: Group) -> NotSent:
    """Returns the outcome of a write that follows one of its group that was not done."""
    sent = "refused together with others, and not sent alone" if write.refused else "not sent"
    return NotSent(f"{sent}, because {group.failed} before it failed")


def unsent(request: Request, why: GatewayError) -> GatewayError:
    """Returns the outcome of a request that is not sent, or not again after a refusal."""
    if not isinstance(request, Write) or (refused := request.refused) is None:
        return why
    return Refused(
        f"{refused}; after that: {why}", code=refused.code, refusal=refused.refusal, unexecuted=True
    )


def why_not_commanded(driver: AnyDriver, command: str, *, control: bool) -> str:
    """Returns the reason to refuse a command; empty if the device accepts it."""
    known = driver.controls if isinstance(driver, Controllable) else frozenset()
    if not known:
        return f"a {driver.protocol} device takes no commands"
    if command not in known:
        return f"{command!r} is none of its commands: {', '.join(sorted(known))}"
    return "" if control else "`control: true` is missing in the file"
