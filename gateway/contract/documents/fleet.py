"""The short report of a gateway, for those who look after many: docs/fleet.md."""

from typing_extensions import TypedDict

from gateway.contract.documents.state import Standing
from gateway.contract.documents.values import Number, Time


class ReportDocument(TypedDict):
    """The whole gateway in a few hundred bytes.

    `devices`: their number by standing. `load`: of its busiest line, measured. `faults`: the number
    of each kind, and `fault` is the first of them as a sentence. `digest` to `refused_why`: the
    configuration file. `certificate_days`: of the certificate that ends first. `disk_days`: until
    the disk of history is full. `stand`: of a member of a standby group.
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
    stand: str | None
