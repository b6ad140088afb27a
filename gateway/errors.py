"""The gateway's exceptions, named by what the caller does next.

GatewayError
├── ConfigError          fix the file; nothing has been sent
├── BadValue             refuse the write; nothing has been sent
├── Busy                 try again later; nothing has been sent
│   ├── NotSent          a write of a group, after another one that was not done
│   └── Superseded       a newer write of the same tag took its place: do not try again
├── Unknown              there is no such thing; nothing was done
├── NotAllowed           sign the request; nothing was done
├── Repeated             a signed request arrived twice: the first one may have been done
├── NothingToAcknowledge look at the alarm again
├── NoHistory            ask without a time: nothing of the past is kept
├── Damaged              a part of the history file is lost; the rest can be read
├── Offline              the device is offline; nothing has been sent
│   └── WrongDevice      another device replies in its place; nothing has been sent
├── LineDown             reopen the port; pending writes fail at once
│   ├── Lent             wait: another program has the port
│   └── CallEnded        dial again later: the modem is there, the telephone call is not
└── DeviceError          one device, one transaction
    ├── Took             the device limited the written value, and said so
    ├── Refused          the device sent an error reply with its code: report it, do not repeat
    └── Unclear          the device may or may not have done it: repeat reads
        ├── NoReply      silence until the time-out
        └── Garbled      bytes that are no frame or no reply; kept for the log
"""

from collections.abc import Sequence
from enum import StrEnum
from typing import NamedTuple


def words_of(error: Exception) -> str:
    """Returns an error of the system in its words, without its number; the text of another error.

    Of ports it is `gateway.transport.os_errors`, which knows what a number means there.
    """
    inner = getattr(error, "reason", None)  # of urllib
    if isinstance(inner, OSError):
        error = inner
    return getattr(error, "strerror", None) or str(error) or type(error).__name__


class GatewayError(Exception):
    """The base of all exceptions the gateway raises."""


class ConfigError(GatewayError, ValueError):
    """A mistake in the configuration. Also a ValueError, so that pydantic reports its place."""


class BadValue(GatewayError, ValueError):
    """A value that cannot be written to its tag; nothing has been sent."""


class Busy(GatewayError):
    """A request that could not be sent in time; nothing has been sent."""


class NotSent(Busy):
    """A write of a group that was not sent, because another one of it was not done."""


class Unknown(GatewayError):
    """A request to something that is not there; nothing was done."""


class NotAllowed(GatewayError):
    """The signature is missing, wrong or too old; nothing was done."""


class Repeated(GatewayError):
    """A signed request arrived twice. The first one may have been done."""


class NothingToAcknowledge(GatewayError):
    """An acknowledgement of an alarm that is normal, or was raised again."""


class NoHistory(GatewayError):
    """A query for the past to a gateway that keeps no history."""

    def __init__(self) -> None:
        super().__init__("no history is kept here: ask without _time")


class Superseded(Busy):
    """A waiting write whose place a newer one of the same tag took; nothing has been sent."""


class Damaged(GatewayError):
    """A part of the history file that cannot be read, or does not fit its checksum."""


class Offline(GatewayError):
    """A write to an offline device; nothing has been sent."""


class WrongDevice(Offline):
    """A write to a device that is not the one of the file; nothing has been sent."""


class LineDown(GatewayError):
    """A port that cannot be opened or was lost."""


class Lent(LineDown):
    """A port that another program has for a while."""


class CallEnded(LineDown):
    """A telephone call that failed, or ended without our doing. `result`: in a word or two."""

    def __init__(self, message: str, result: str) -> None:
        super().__init__(message)
        self.result = result


class DeviceError(GatewayError):
    """A transaction with one device that failed."""


class Refusal(StrEnum):
    """The kind of an error reply, whatever the maker's code: it decides the next step."""

    ADDRESS = "address"  # the address does not exist: halve the block, remember the address
    DAMAGED = "damaged"  # our request arrived damaged and did nothing: repeat reads
    BUSY = "busy"  # the device is busy: pause, then repeat
    OTHER = "other"  # report it


class Refused(DeviceError):
    """An error reply.

    `code` is the maker's code as the manual prints it ("28", "06", "02"). `unexecuted`: the device
    refused the frame itself, so of several writes in it none was done.
    """

    def __init__(
        self,
        message: str,
        *,
        code: str,
        refusal: Refusal = Refusal.OTHER,
        unexecuted: bool = False,
    ) -> None:
        super().__init__(message)
        self.code = code
        self.refusal = refusal
        self.unexecuted = unexecuted


class Took(DeviceError):
    """The device acknowledged a write with other units than those sent: these are what it took."""

    def __init__(self, units: Sequence[int]) -> None:
        super().__init__(f"acknowledged with {units} instead")
        self.units = units


class Unclear(DeviceError):
    """A transaction without a clear result: the device may or may not have done it."""


class Evidence(StrEnum):
    """The bytes received instead of a good reply, by kind: the input of the diagnosis."""

    SILENCE = "silence"  # no byte at all
    ECHO = "echo"  # only our own request
    NOISE = "noise"  # bytes that are no frame: baud rate, parity, format, noise
    CHECKSUM = "checksum"  # a frame with a wrong checksum
    STATION = "station"  # a good frame from another station
    SHAPE = "shape"  # a good frame that answers another request
    TRUNCATED = "truncated"  # a frame without its end
    SLOW = "slow"  # the right reply, after the time-out
    REFUSAL = "refusal"  # a good frame that refuses another request than was sent


class Diagnosis(NamedTuple):
    """The likely cause of a trouble. Programs compare `code`, people read `text`. Both empty: there
    is none."""

    code: str
    text: str


NO_TROUBLE = Diagnosis("", "")


class NoReply(Unclear):
    """Silence until the time-out."""

    evidence = Evidence.SILENCE


class Garbled(Unclear):
    """Bytes that are no frame, or a frame that is no reply to the request.

    The message becomes the outcome of a write or the detail of a value, so it has no bytes. `data`
    holds the first ones for the log, `evidence` the kind of fault.
    """

    def __init__(
        self, message: str, data: bytes = b"", *, evidence: Evidence = Evidence.NOISE
    ) -> None:
        super().__init__(message)
        self.data = data[:64]
        self.evidence = evidence


class RefusedOther(Garbled):
    """An error reply that names another request. Some devices refuse every request so; it may also
    be that to another master. `code`: as in `Refused`.
    """

    def __init__(self, message: str, data: bytes, *, code: str) -> None:
        super().__init__(message, data, evidence=Evidence.REFUSAL)
        self.code = code


class Unsteady(Garbled):
    """Two good replies that differ although they must be equal."""


def log_fields(error: DeviceError) -> dict[str, str]:
    """Returns what the log tells of an error: why, and the bytes that no sentence has."""
    heard = error.data if isinstance(error, Garbled) else b""
    return {"why": str(error)} | ({"bytes": heard.hex(" ")} if heard else {})
