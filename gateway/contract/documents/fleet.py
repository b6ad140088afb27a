"""The short report of a gateway, for those who look after many: docs/fleet.md."""

from typing import Annotated, Literal, NotRequired

from typing_extensions import TypedDict

from gateway.contract.documents.state import Standing
from gateway.contract.documents.values import Number, Time, words


class ReportDocument(TypedDict):
    """The whole gateway in a few hundred bytes.

    `devices`: their number by standing. `load`: of its busiest line, measured. `faults`: the number
    of each kind, and `fault` is the first of them as a sentence. `digest` to `refused_why`: the
    configuration file. `certificate_days`: of the certificate that ends first. `disk_days`: until
    the disk of history is full. `group`, `stand`: of a member of a standby group.
    """

    contract: Number
    name: str
    version: str
    time: Time
    up: float
    tags: int
    not_real: bool
    lines: int
    lines_down: int
    devices: dict[Standing, int]
    load: float | None
    faults: dict[str, int]
    fault: str
    warnings: int
    digest: str
    revision: str | None
    loaded: Time | None
    refused: Time | None
    refused_why: str
    certificate_days: float | None
    disk_days: float | None
    group: NotRequired[str | None]
    stand: str | None


class RemoteDocument(TypedDict):
    """The last file that a writer gave the gateway. `until`: then it goes back, unless somebody
    confirms it. `digest`, `before`: of that file, and of the one before. `earlier`: digests of the
    files that are kept, the newest last."""

    state: Annotated[str, words("none", "waiting", "confirmed", "reverted", "failed")]
    by: str
    at: Time | None
    until: Time | None
    digest: str
    before: str
    why: str
    earlier: list[str]


class RemoteOrder(TypedDict):
    """`file`: the whole text; `confirm`: seconds until it goes back; `digest`: of the file that is
    confirmed, or of the earlier one that comes back."""

    do: Literal["check", "apply", "confirm", "revert", "rollback"]
    file: NotRequired[str]
    confirm: NotRequired[float]
    digest: NotRequired[str]
