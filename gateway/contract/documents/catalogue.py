"""Every kind of document: its keys, what a client does there, and its type.

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


class Kind(NamedTuple):
    """One kind of document. `key`: below the prefix; `takes`: the payload that a client sends."""

    name: str
    key: str
    verbs: tuple[str, ...]
    shape: Any
    takes: Any = None


_TAG = "{device}/{tag}"
_OWN = "@gateway/{gateway}"
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
    "damaged": state.DamagedDocument,
    "transfers/{number}": state.TransferDocument,
    "doors/{door}": state.DoorDocument,
    "notify/{way}": state.NotifyDocument,
    "clock": state.ClockDocument,
    "parts/{part}": state.PartDocument,
    "certificates/{setting}": state.CertificateDocument,
    "history": state.HistoryDocument,
    "reload": state.ReloadDocument,
    "report": fleet.ReportDocument,
    "remote/{file}": fleet.RemoteDocument,
    "standby": state.StandbyDocument,
    "claim/{session}": state.ClaimDocument,
}
KINDS = (
    Kind("value", _TAG, _SEEN, values.ValueDocument),
    Kind(RAW, _TAG, _SEEN, values.WithoutValue),
    Kind("past values", _TAG, (PAST,), values.ValueDocument),
    Kind("past values: bucket", _TAG, (PAST,), values.BucketDocument),
    Kind("page", f"{_OWN}/page", (GET,), values.PageDocument),
    Kind("block", "{device}/@block", _SEEN, values.BlockDocument),
    Kind(PLACE, "{device}/@block", (SUBSCRIBE,), values.PlaceDocument),
    Kind("meta", f"{_TAG}/@meta", (GET,), values.MetaDocument),
    Kind("write", f"{_TAG}/@set", (SEND,), requests.WrittenDocument, requests.WriteRequest),
    Kind("group", "{device}/@set", (SEND,), requests.GroupDocument, requests.GroupRequest),
    Kind("command", "{device}/@{command}", (SEND,), requests.CommandDocument),
    Kind("command to a line", f"{_OWN}/lines/{{line}}/global", (SEND,), requests.CommandDocument),
    Kind("peek", "{device}/@peek", (SEND,), requests.PeekDocument),
    Kind("error", "{any}", (GET, PAST, SEND), requests.FailureDocument | requests.GroupDocument),
    Kind("outcome", f"{_OWN}/writes", (SUBSCRIBE, PAST), requests.OutcomeDocument),
    Kind("outcome: suppressed", f"{_OWN}/writes", (SUBSCRIBE, PAST), requests.SuppressedDocument),
    Kind("alarm", f"{_OWN}/alarms/{{alarm}}", _SEEN, requests.AlarmDocument),
    Kind("past alarm", f"{_OWN}/alarms/{{alarm}}", (PAST,), requests.AlarmEvent),
    Kind(
        "acknowledgement",
        f"{_OWN}/alarms/{{alarm}}",
        (SEND,),
        requests.AlarmDocument,
        requests.AcknowledgeRequest,
    ),
    Kind("release", f"{_OWN}/doors/{{door}}", (SEND,), state.DoorDocument, requests.DoorRequest),
    Kind("file order", f"{_OWN}/remote/file", (SEND,), fleet.RemoteDocument, fleet.RemoteOrder),
    Kind("audit", f"{_OWN}/audit/{{number}}", (PAST,), requests.AuditRecord),
    Kind("trace", f"{_OWN}/lines/{{line}}/@trace", (SUBSCRIBE,), requests.TraceDocument),
    Kind("description", f"{_OWN}/@describe", (GET,), dict[str, Any]),
    Kind("introspection", f"{_OWN}/@introspect", (GET,), state.IntrospectDocument),
    *(Kind(path.partition("/{")[0], f"{_OWN}/{path}", _SEEN, of) for path, of in _STATE.items()),
)


@cache
def described() -> bytes:
    """Returns the content of `FILE`."""
    return FILE.read_bytes()
