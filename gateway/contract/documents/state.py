"""The state of the gateway, its lines, its devices and its parts: docs/status.md."""

from typing import Annotated, Literal, NotRequired

from typing_extensions import TypedDict

from gateway.contract.documents.values import Number, Time, words
from gateway.engine.device.identity import Verdict
from gateway.engine.device.records import CallState
from gateway.tags.tag import NotReal

Standing = Annotated[str, words("starting", "up", "failing", "silent")]


class StatusDocument(TypedDict):
    """The gateway."""

    contract: Number
    name: str
    version: str
    time: Time
    up: float
    tags: int
    simulated: list[str]
    replayed: list[str]
    lines: dict[str, bool]
    devices: dict[str, Standing]
    refused_devices: dict[str, str]
    refused_claims: list[str]
    answered_elsewhere: str | None


class Measured(TypedDict):
    load: float | None
    requests_per_second: float | None
    slowest_write: float


class Expected(TypedDict):
    load: float
    load_proven: NotRequired[float]
    requests_per_second: float
    cycle: float
    worst_write: float


class CallsDocument(TypedDict):
    """The telephone calls of a line."""

    state: Annotated[CallState, words(*CallState)]
    since: float | None
    next: float | None
    connected: bool
    made: int
    failed: int
    in_a_row: int
    last_result: str
    last_failure: str
    results: dict[str, int]


class LineDocument(TypedDict):
    """One line; with `served`: one that masters poll."""

    open: bool
    trouble: str
    silent: NotRequired[bool]
    last_trouble: str
    opened: int
    open_for: float
    down_for: NotRequired[float | None]
    losses: NotRequired[int]
    open_time: float
    baudrate: int
    devices: dict[str, Standing]
    busy_time: float
    measured: Measured
    unasked_bytes: int
    doubtful: NotRequired[bool]
    expected: Expected
    calls: CallsDocument | None
    served: NotRequired[bool]
    stale_requests: NotRequired[int]
    unsent_replies: NotRequired[int]


class IdentityDocument(TypedDict):
    verdict: Annotated[Verdict, words(*Verdict)]
    wanted: dict[str, str]
    told: dict[str, list[str]]


class Lately(TypedDict):
    requests: int
    failed: dict[str, int]


class BlockReads(TypedDict):
    tags: str
    every: float
    measured_every: float | None
    worst_age: float | None
    reads: int
    overruns: int


class DeviceDocument(TypedDict):
    """One device; with `served`: a station of this gateway that masters poll."""

    protocol: str
    station: int
    standing: Standing
    diagnosis: str
    diagnosis_code: NotRequired[str]
    identity: IdentityDocument | None
    silent_for: NotRequired[float | None]
    silences: NotRequired[int]
    lately: NotRequired[Lately]
    exchanges: int
    writes: int
    slowest_write: float
    wire_time: float
    turnaround: float | None
    silence: float
    late_replies: int
    unasked_frames: int
    frames_heard: int
    overruns: int
    overdue: int
    retries: int
    last_good: float | None
    failures: dict[str, int]
    refusals: dict[str, int]
    refused_addresses: list[str]
    requests: list[BlockReads]
    served: NotRequired[bool]
    stale_after: NotRequired[float | None]


class ZenohDocument(TypedDict):
    """Messages, queries and connections."""

    published: int
    superseded: int
    superseded_most: dict[str, int]
    congested: int
    dropped: int
    queries: int
    refused: int
    puts_refused: int
    refusals_untold: int
    links: int
    to: list[Literal["router", "peer", "client"]]
    connect: list[str]


class OutcomesDocument(TypedDict):
    """Writes and commands by outcome, and their times."""

    counts: dict[str, int]
    sent: int
    seconds: float
    took: dict[str, int]


class AlarmCounts(TypedDict):
    """The number of alarms by state."""

    normal: int
    active: int
    acknowledged: int
    returned: int
    shelved: NotRequired[int]
    out_of_service: NotRequired[int]
    raised_in_10_min: NotRequired[int]
    flood_since: NotRequired[Time | None]


class FaultDocument(TypedDict):
    """A trouble that needs a person. Programs count by `code`."""

    code: str
    text: str


class PartDocument(TypedDict):
    """Why a part stopped; `why` is empty while it works. `faults`: those that it says itself."""

    why: str
    again: int | None
    failures: int
    faults: list[FaultDocument]


class FileDocument(TypedDict):
    """Why the last change of a file is not on disk; empty: it is."""

    trouble: str


class CertificateDocument(TypedDict):
    """The days that a certificate has left."""

    file: str
    expires: Time | None
    days: float | None
    trouble: str


class ClockDocument(TypedDict):
    """Jumps of the clock of the machine."""

    jumps: int
    last: float | None
    ago: float | None


class ReloadDocument(TypedDict):
    """The configuration file. `revision`: its last commit in git, with `+` if it was changed since.

    `digest`: of all settings, without comments and layout; files of one digest do the same.
    """

    file: str
    loaded: Time
    digest: NotRequired[str]
    revision: NotRequired[str | None]
    reloads: int
    refused: Time | None
    why: list[str]


class StandbyDocument(TypedDict):
    """The gateway in its standby group."""

    group: str
    stand: Literal["waiting", "claiming", "active", "relieved"]
    others_active: list[str]
    others_waiting: list[str]


class ClaimDocument(TypedDict):
    """The devices of a gateway; `signature` if the plant has a secret. `origins`: of those devices
    that are not real."""

    contract: Number
    ticket: int
    group: str | None
    devices: list[str]
    origins: NotRequired[dict[str, NotReal]]
    signature: NotRequired[str]


class ServedKey(TypedDict):
    key: str
    verbs: list[str]


class ServedDevice(TypedDict):
    """`commands`: those that the file permits; `writable`: the number of tags with `write`;
    `templates`: that the device uses."""

    tags: int
    writable: int
    commands: list[str]
    blocks: bool
    templates: list[str]


class IntrospectDocument(TypedDict):
    """`signed`: writes, commands and acknowledgements need the signature of a writer."""

    contract: Number
    gateway: str
    version: str
    signed: bool
    history: bool
    documents: dict[str, ServedKey]
    devices: dict[str, ServedDevice]
