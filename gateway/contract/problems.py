"""The error words of the contract, and the errors that they stand for."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

from gateway import errors


class Problem(StrEnum):
    """The error words of the contract."""

    NOT_WRITABLE = "not-writable"
    BAD_VALUE = "bad-value"
    REFUSED = "refused"  # by the device; `code` is its own
    UNCLEAR = "unclear"  # the device may or may not have executed it
    LINE_DOWN = "line-down"
    NO_REPLY = "no-reply"  # the device is silent; nothing was sent
    WRONG_DEVICE = "wrong-device"  # another device replies in its place; nothing was sent
    BUSY = "busy"  # too many requests are waiting; nothing was done
    UNKNOWN_TAG = "unknown-tag"
    NOT_SENT = "not-sent"  # a tag of a group: another one was wrong, or not done before it
    INCOMPLETE = "incomplete"  # of a group: some tags were written, and others were not
    NOT_ALLOWED = "not-allowed"  # the client's signature is missing, wrong or too old
    NOTHING_TO_ACKNOWLEDGE = "nothing-to-acknowledge"  # the alarm is normal, or was raised again
    BAD_QUERY = "bad-query"  # a read with parameters that cannot be parsed
    DAMAGED = "damaged"  # a part of the history file is lost; all the rest was answered
    NO_HISTORY = "no-history"  # a read of the past from a gateway without history


# Of the most special class of an error. All others are unclear.
PROBLEMS: Mapping[type, Problem] = {
    errors.NotSent: Problem.NOT_SENT,
    errors.BadValue: Problem.BAD_VALUE,
    errors.Refused: Problem.REFUSED,
    errors.LineDown: Problem.LINE_DOWN,
    errors.Busy: Problem.BUSY,
    errors.Offline: Problem.NO_REPLY,
    errors.WrongDevice: Problem.WRONG_DEVICE,
    errors.Damaged: Problem.DAMAGED,
    errors.NoHistory: Problem.NO_HISTORY,
    errors.Unknown: Problem.UNKNOWN_TAG,
    errors.NotAllowed: Problem.NOT_ALLOWED,
    errors.NothingToAcknowledge: Problem.NOTHING_TO_ACKNOWLEDGE,
}


@dataclass(frozen=True, slots=True)
class Failure:
    """A request that was not done, or whose result is unclear."""

    problem: Problem
    reason: str
    code: str | None = None
