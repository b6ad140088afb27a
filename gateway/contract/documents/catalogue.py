"""Every kind of document: its keys, what a client does there, and its type; those of parts: `Kind`.

`FILE` has the same as JSON Schema, for consumers. `make schema` writes it with
`benchmarks/schemas.py`.
"""

from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from gateway.contract.documents import fleet, requests, state, values
from gateway.tags import Reason

FILE = Path(__file__).parent / "contract.json"
SUBSCRIBE, GET, PAST, SEND = "subscribe", "get", "get with _time", "query with a payload"
_SEEN = (SUBSCRIBE, GET)
RAW, PLACE = "raw value: attachment", "block: attachment"


class DocumentKind(NamedTuple):
    """One kind of document. `key`: below the prefix; `takes`: the payload that a client sends."""

    name: str
    key: str
    verbs: tuple[str, ...]
    shape: Any
    takes: Any = None


def own(path: str) -> str:
    """Returns the key of a gateway's own document."""
    return f"@gateway/{{gateway}}/{path}"


def in_status(path: str, shape: Any) -> DocumentKind:
    """Returns the kind of the status documents of a path, such as `doors/{door}`."""
    return DocumentKind(path.partition("/{")[0], own(path), _SEEN, shape)


_TAG = "{device}/{tag}"
# Of values that are not good: the status codes of OPC UA, and the status signals of NAMUR NE 107.
REASONS = {
    Reason.STARTING: ("BadWaitingForInitialData", "C"),
    Reason.NO_REPLY: ("BadDeviceFailure", "F"),
    Reason.GARBLED: ("BadCommunicationError", "F"),
    Reason.REFUSED: ("BadConfigurationError", "F"),
    Reason.LINE_DOWN: ("BadNotConnected", "F"),
    Reason.MAINTENANCE: ("BadOutOfService", "C"),
    Reason.OVERDUE: ("BadResourceUnavailable", "F"),
    Reason.DISABLED: ("BadOutOfService", "C"),
    Reason.NOT_A_NUMBER: ("BadSensorFailure", "F"),
    Reason.WRONG_DEVICE: ("BadConfigurationError", "F"),
    Reason.OUT_OF_RANGE: ("UncertainEngineeringUnitsExceeded", "S"),
}
_STATE: dict[str, Any] = {  # by path
    "status": state.StatusDocument,
    "lines/{line}": state.LineDocument,
    "devices/{device}": state.DeviceDocument,
    "zenoh": state.ZenohDocument,
    "outcomes": state.OutcomesDocument,
    "alarms": state.AlarmCounts,
    "files/{file}": state.FileDocument,
    "clock": state.ClockDocument,
    "parts/{part}": state.PartDocument,
    "certificates/{setting}": state.CertificateDocument,
    "reload": state.ReloadDocument,
    "report": fleet.ReportDocument,
    "remote/{file}": fleet.RemoteDocument,
    "standby": state.StandbyDocument,
    "claim/{session}": state.ClaimDocument,
}
KINDS = (
    DocumentKind("value", _TAG, _SEEN, values.ValueDocument),
    DocumentKind(RAW, _TAG, _SEEN, values.WithoutValue),
    DocumentKind("past values", _TAG, (PAST,), values.ValueDocument),
    DocumentKind("past values: bucket", _TAG, (PAST,), values.BucketDocument),
    DocumentKind("page", own("page"), (GET,), values.PageDocument),
    DocumentKind("page: samples", own("page/samples"), (GET,), values.PageSamples),
    DocumentKind("block", "{device}/@block", _SEEN, values.BlockDocument),
    DocumentKind(PLACE, "{device}/@block", (SUBSCRIBE,), values.PlaceDocument),
    DocumentKind("meta", f"{_TAG}/@meta", (GET,), values.MetaDocument),
    DocumentKind("write", f"{_TAG}/@set", (SEND,), requests.WrittenDocument, requests.WriteRequest),
    DocumentKind("group", "{device}/@set", (SEND,), requests.GroupDocument, requests.GroupRequest),
    DocumentKind("command", "{device}/@{command}", (SEND,), requests.CommandDocument),
    DocumentKind(
        "command to a line", own("lines/{line}/global"), (SEND,), requests.CommandDocument
    ),
    DocumentKind("peek", "{device}/@peek", (SEND,), requests.PeekDocument),
    DocumentKind(
        "error", "{any}", (GET, PAST, SEND), requests.FailureDocument | requests.GroupDocument
    ),
    DocumentKind("outcome", own("writes"), (SUBSCRIBE, PAST), requests.OutcomeDocument),
    DocumentKind(
        "outcome: suppressed", own("writes"), (SUBSCRIBE, PAST), requests.SuppressedDocument
    ),
    DocumentKind("alarm", own("alarms/{alarm}"), _SEEN, requests.AlarmDocument),
    DocumentKind("past alarm", own("alarms/{alarm}"), (PAST,), requests.AlarmEvent),
    DocumentKind(
        "acknowledgement",
        own("alarms/{alarm}"),
        (SEND,),
        requests.AlarmDocument,
        requests.AcknowledgeRequest,
    ),
    DocumentKind(
        "file order", own("remote/file"), (SEND,), fleet.RemoteDocument, fleet.RemoteOrder
    ),
    DocumentKind("audit", own("audit/{number}"), (PAST,), requests.AuditRecord),
    DocumentKind("trace", own("lines/{line}/@trace"), (SUBSCRIBE,), requests.TraceDocument),
    DocumentKind("description", own("@describe"), (GET,), dict[str, Any]),
    DocumentKind("introspection", own("@introspect"), (GET,), state.IntrospectDocument),
    *(in_status(path, of) for path, of in _STATE.items()),
)


@cache
def described() -> bytes:
    """Returns the content of `FILE`."""
    return FILE.read_bytes()
