"""The codes of the manuals for a transfer that does not work, and the ends of its writes.

Source: Vigor VB/VH manual, B-3-3 and B-3-6: the instruction working status of LINK and MBUS.
"""

from enum import StrEnum
from typing import NamedTuple

from gateway import errors
from gateway.tags import Reason


class Code(StrEnum):
    """The instruction working status. Lengths and kinds (2, 4, 6) are mistakes in the file."""

    NORMAL = "0"
    LENGTH = "2"
    DEVICE_TYPE = "4"
    DEVICE_NUMBER = "5"
    KINDS = "6"
    NO_RESPONSE = "A"
    ABNORMAL = "B"

    @property
    def sentence(self) -> str:
        return _SENTENCES[self]


_SENTENCES = {
    Code.NORMAL: "normal data transmission",
    Code.LENGTH: "error of the length of the transferred data (1 to 64)",
    Code.DEVICE_TYPE: "error of the designated device type",
    Code.DEVICE_NUMBER: "error of the designated device ID number",
    Code.KINDS: "the attributes of the designated devices are different",
    Code.NO_RESPONSE: "normal communications but no response",
    Code.ABNORMAL: "abnormal communications",
}
_OF_SOURCE = {
    Reason.NO_REPLY: Code.NO_RESPONSE,
    Reason.STARTING: Code.NO_RESPONSE,
    Reason.DISABLED: Code.NO_RESPONSE,
    Reason.OVERDUE: Code.NO_RESPONSE,
    Reason.REFUSED: Code.DEVICE_NUMBER,
}
# The device says itself that it did nothing, and that the same request may succeed.
_AGAIN = (errors.Refusal.BUSY, errors.Refusal.DAMAGED)


class End(StrEnum):
    """The end of a write."""

    DONE = "done"
    NOT_DONE = "not done"  # certainly: it may be tried again
    REFUSED = "refused"  # also certainly, but the same value would be refused again
    UNCLEAR = "unclear"  # it may have been done, so it must not be repeated


class Outcome(NamedTuple):
    """The end of a write with its code and a sentence. `code`: None if the manuals have none."""

    end: End
    code: Code | None
    why: str = ""


DONE = Outcome(End.DONE, Code.NORMAL)


def outcome_of(error: errors.GatewayError) -> Outcome:
    """Returns the end of a write that failed."""
    why = str(error) or type(error).__name__
    match error:
        case errors.BadValue() | errors.Superseded():
            return Outcome(End.REFUSED, None, why)
        case errors.Refused(refusal=refusal) if refusal in _AGAIN:
            return Outcome(End.NOT_DONE, Code.ABNORMAL, why)
        case errors.Refused(refusal=refusal):
            found = refusal is errors.Refusal.ADDRESS
            return Outcome(End.REFUSED, Code.DEVICE_NUMBER if found else Code.ABNORMAL, why)
        case errors.Offline():
            return Outcome(End.NOT_DONE, Code.NO_RESPONSE, why)
        case errors.Busy() | errors.LineDown():
            return Outcome(End.NOT_DONE, Code.ABNORMAL, why)
        case errors.NoReply():
            return Outcome(End.UNCLEAR, Code.NO_RESPONSE, why)
    return Outcome(End.UNCLEAR, Code.ABNORMAL, why)


def code_of_source(reason: Reason | None) -> Code:
    """Returns the code for a source without a value."""
    return Code.ABNORMAL if reason is None else _OF_SOURCE.get(reason, Code.ABNORMAL)
