"""The document of a row of the transfers: docs/status.md."""

from typing import Literal

from typing_extensions import TypedDict

from gateway.contract.documents.values import Time
from gateway.values import Value

_Ends = TypedDict("_Ends", {"from": str, "to": str})


class TransferDocument(_Ends):
    """One row of the transfers."""

    when: str
    state: Literal["starting", "carried", "stale", "waiting", "refused", "unclear"]
    code: Literal["0", "2", "4", "5", "6", "A", "B"] | None
    meaning: str
    why: str
    value: Value | None
    time: Time | None
    last_carried: float | None
    age: float | None
    carried: int
    not_done: int
    refused: int
    unclear: int
