"""Writes, commands, alarms and the records of them."""

from typing import Annotated, Literal, NotRequired

from typing_extensions import TypedDict

from gateway.contract.documents.values import Origin, Time, Why, words
from gateway.contract.problems import Problem
from gateway.tags import Level, Priority
from gateway.tags.shaping import Limited
from gateway.values import Value
from gateway.values.numerals import Scalar

Error = Annotated[Problem, words(*Problem)]
Logged = Scalar | list[Scalar]  # a long array is a text


class WrittenDocument(TypedDict):
    """A write that the device acknowledged."""

    value: Value
    time: Time
    verified: bool
    acknowledged: bool
    took: float
    note: NotRequired[str]
    origin: NotRequired[Origin]


class FailureDocument(TypedDict):
    """A request that was not done, or with the error `unclear`: may have been done."""

    error: Error
    code: str | None
    reason: str


class GroupDocument(TypedDict):
    """The outcome of each tag of a group; with `error`: not all were written."""

    tags: dict[str, WrittenDocument | FailureDocument]
    took: float
    error: NotRequired[Error]
    code: NotRequired[str | None]
    reason: NotRequired[str]


class CommandDocument(TypedDict):
    """The answer of a device to a command."""

    answer: str
    time: Time
    took: float


class PeekDocument(TypedDict):
    """Words or bits as they were read once."""

    address: str
    units: list[int]
    time: Time
    took: float


OutcomeWord = Annotated[
    Literal["written", "obeyed"] | Problem, words("written", "obeyed", *Problem)
]


class OutcomeDocument(TypedDict):
    """The end of one write or command."""

    key: str
    value: Logged | None
    time: Time
    took: float
    by: str | None
    outcome: OutcomeWord
    verified: NotRequired[bool]
    origin: NotRequired[Origin]
    answer: NotRequired[str]
    code: NotRequired[str | None]
    reason: NotRequired[str]


class SuppressedDocument(TypedDict):
    """Refused requests that were counted only."""

    outcome: Literal["suppressed"]
    count: int
    kinds: dict[str, int]
    time: Time


class Acknowledgement(TypedDict):
    by: str
    time: Time
    via: str | None


class Suppressed(TypedDict):
    """A shelved alarm, or one out of service: by whom, and why; `until`: of a shelved one."""

    by: str
    time: Time
    reason: str
    via: str | None
    until: NotRequired[Time]


class AlarmDocument(TypedDict):
    """An alarm, and the value now."""

    alarm: str
    state: Literal["normal", "active", "acknowledged", "returned"]
    level: Annotated[Level, words(*Level)] | None
    limit: float | bool | None
    value: Value | None
    quality: Literal["good", "uncertain", "bad"]
    time: NotRequired[Time]
    text: str
    reason: NotRequired[Why]
    detail: NotRequired[str]
    origin: NotRequired[Origin]
    limited: NotRequired[Limited]
    value_at_change: Logged | None
    unit: str
    since: Time | None
    raised: Time | None
    acknowledged: Acknowledgement | None
    priority: NotRequired[Annotated[Priority, words(*Priority)]]
    devices: NotRequired[list[str]]
    part_of: NotRequired[str]
    shelved: NotRequired[Suppressed]
    out_of_service: NotRequired[Suppressed]


_CHANGES = "folded", "unfolded", "shelved", "unshelved", "out of service", "in service"


class AlarmEvent(AlarmDocument):
    """A change of an alarm. `change`: what happened, if `event` says only what follows from it."""

    event: Literal["raised", "eased", "ended", "acknowledged"]
    change: NotRequired[Annotated[str, words(*_CHANGES)]]
    by: NotRequired[str | None]
    via: NotRequired[str | None]


class AuditNote(TypedDict):
    """The audit itself; `records` and `left_out`: those that did not get into the file."""

    event: Literal["begins", "left out", "ends"]
    records: NotRequired[int]
    left_out: NotRequired[int]


class AuditRecord(TypedDict):
    """A record of the audit; `before` is the hash of the one before."""

    n: int
    time: Time
    before: str
    event: OutcomeDocument | SuppressedDocument | AlarmEvent | AuditNote


class Exchange(TypedDict):
    """One exchange of a line, decoded."""

    time: float  # seconds since 1970
    took: float
    device: str
    kind: str
    what: str
    result: str
    failed: bool
    values: dict[str, Value | None]


class Piece(TypedDict):
    """Bytes of a line, in hex."""

    time: float  # seconds since 1970
    way: str
    bytes: str


class TraceDocument(TypedDict):
    """The exchanges and bytes that passed on a line."""

    number: int
    missed: int
    events: list[Exchange | Piece]


class WrappedValue(TypedDict):
    value: Value


WriteRequest = Value | WrappedValue
GroupRequest = dict[str, WriteRequest]  # by tag, in their order


class AcknowledgeRequest(TypedDict):
    """The operator, and the `raised` that the operator saw; with `do`, another order."""

    by: str
    raised: NotRequired[str | None]
    do: NotRequired[Literal["acknowledge", "shelve", "unshelve", "out-of-service", "in-service"]]
    reason: NotRequired[str]
    seconds: NotRequired[float]
