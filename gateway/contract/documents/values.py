"""Values, their descriptions and their past."""

from typing import Annotated, Literal, NotRequired

from typing_extensions import TypedDict

from gateway.tags import Reason
from gateway.tags.shaping import Limited
from gateway.tags.tag import OriginWord
from gateway.values import Value


class Text:
    """A text of some kind, for the schema."""

    def __init__(self, **schema: object) -> None:
        self._schema = {"type": "string", **schema}

    def __get_pydantic_json_schema__(self, core: object, handler: object) -> dict[str, object]:
        return self._schema


def words(*known: str) -> Text:
    """Words that may become more without another number of the contract."""
    return Text(examples=list(known))


Number = Literal[1]  # `CONTRACT`
Time = Annotated[str, Text(format="date-time")]  # UTC
Origin = OriginWord
Why = Annotated[Reason, words(*Reason)]
_WhyOfGap = Annotated[str, words(*Reason, "not-recorded", "damaged")]


class KnownValue(TypedDict):
    """A value as the device had it at `time`."""

    value: Value
    quality: Literal["good"]
    time: Time
    text: NotRequired[str]  # its name
    origin: NotRequired[Origin]
    limited: NotRequired[Limited]  # at this end of its clamp: the device may be beyond


class UncertainValue(TypedDict):
    """A value as the device had it at `time`, which is outside the range of its sensor."""

    value: Value
    quality: Literal["uncertain"]
    reason: Why
    time: Time
    detail: NotRequired[str]  # for people: its words may change
    text: NotRequired[str]
    origin: NotRequired[Origin]
    limited: NotRequired[Limited]


class UnknownValue(TypedDict):
    """The reason why there is no value, since `time`."""

    value: None
    quality: Literal["bad"]
    reason: Why
    time: Time
    detail: NotRequired[str]  # for people: its words may change
    origin: NotRequired[Origin]


ValueDocument = KnownValue | UncertainValue | UnknownValue
BlockDocument = dict[str, ValueDocument]  # by tag


class PlaceDocument(TypedDict):
    """The attachment of a published block: `seq` counts its messages. `epoch` is another one after
    each start of the gateway, and `seq` is 1 again."""

    epoch: str
    seq: int


class WithoutValue(TypedDict):
    """The attachment of a value with `payload: raw`; `reason` if it is not good."""

    quality: Literal["good", "uncertain", "bad"]
    time: Time
    reason: NotRequired[Why]
    detail: NotRequired[str]
    text: NotRequired[str]
    origin: NotRequired[Origin]
    limited: NotRequired[Limited]


_Ends = TypedDict("_Ends", {"from": list[float] | None, "to": list[float] | None})


class Deadband(TypedDict):
    amount: float
    percent: bool


class Limits(TypedDict):
    min: float | None
    max: float | None


class WriteLimits(Limits):
    verify: bool


class Counter(TypedDict):
    modulus: int
    most: int


class MetaDocument(_Ends):
    """The description of a tag."""

    contract: Number
    type: str
    raw_type: str
    length: int | None
    address: str
    every: float
    computed: str | None
    origin: Origin | None
    unit: str
    description: str
    scale: float
    offset: float
    decimals: int | None
    clamp: Limits | None
    range: Limits | None
    invert: bool
    enum: dict[str, str] | None
    debounce: float | None
    counter: Counter | None
    publish: str
    deadband: Deadband | None
    heartbeat: float | None
    history: bool
    payload: str
    event: bool
    write: WriteLimits | None


class BucketDocument(TypedDict):
    """The values of a tag in one span of time."""

    time: Time  # its beginning
    quality: Literal["good", "partial", "bad"]
    good: int
    bad: int
    known: float  # seconds with a valid value
    min: NotRequired[Value | None]
    max: NotRequired[Value | None]
    mean: NotRequired[float | None]
    last: NotRequired[Value | None]
    reason: NotRequired[_WhyOfGap | None]
    origin: NotRequired[Origin]


class PageSamples(TypedDict):
    """Samples of a page: the key and the value of each, in the order of recording."""

    keys: list[str]
    values: list[ValueDocument]


class PageDocument(TypedDict):
    """The last reply to a query with `page`."""

    samples: int
    complete: bool
    next: str
    again: NotRequired[int]  # of the samples, the last: they come again in the next page
    damaged: NotRequired[str]
