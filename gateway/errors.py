"""Everything that can go wrong, named after what the caller should do next.

GatewayError
├── ConfigError          fix the file; nothing has been sent
├── BadValue             refuse the write; nothing has been sent
├── Busy                 ask again later; nothing has been sent
├── Offline              the device does not answer; nothing has been sent
├── LineDown             reopen the port; pending writes fail at once
└── DeviceError          one device, one conversation
    ├── Refused          it answered "no", with its code: report it, do not repeat
    └── Unclear          it may or may not have been done: repeat reads
        ├── NoReply      silence until the time-out
        └── Garbled      bytes that are no frame; kept for the log
"""

from enum import StrEnum


class GatewayError(Exception):
    """Whatever the gateway itself raises."""


class ConfigError(GatewayError, ValueError):
    """The configuration is wrong; also a ValueError, so that pydantic says where."""


class BadValue(GatewayError, ValueError):
    """The value cannot be written to this tag; nothing has been sent."""


class Busy(GatewayError):
    """The write could not be sent in time; nothing has been sent."""


class Offline(GatewayError):
    """The device is silent, so the write was not sent at all."""


class LineDown(GatewayError):
    """The port is not there, or went away."""


class DeviceError(GatewayError):
    """A conversation with one device did not end well."""


class Refusal(StrEnum):
    """What a refusal asks of us, whatever the maker's code for it is."""

    ADDRESS = "address"  # this address never: split the block, remember the culprit
    DAMAGED = "damaged"  # our frame did not arrive whole, nothing was done: reads are asked again
    BUSY = "busy"  # later: leave the device alone for a while
    OTHER = "other"  # report it


class Refused(DeviceError):
    """The device answered "no".

    `code` is the maker's own code as its manual prints it ("28", "06", "02").
    """

    def __init__(self, message: str, *, code: str, refusal: Refusal = Refusal.OTHER) -> None:
        super().__init__(message)
        self.code = code
        self.refusal = refusal


class Unclear(DeviceError):
    """Nobody can say whether it was done."""


class Evidence(StrEnum):
    """What was heard instead of a good reply: the raw material of a diagnosis."""

    SILENCE = "silence"  # no byte at all
    ECHO = "echo"  # only our own request
    NOISE = "noise"  # bytes that are no frame: baud rate, parity, format, noise
    CHECKSUM = "checksum"  # a frame whose sum is wrong
    STATION = "station"  # a good frame from another station
    SHAPE = "shape"  # a good frame that answers some other question
    TRUNCATED = "truncated"  # a frame that began and did not end
    SLOW = "slow"  # the right answer, after the time-out


class NoReply(Unclear):
    """Silence until the time-out."""

    evidence = Evidence.SILENCE


class Garbled(Unclear):
    """Bytes that are no frame, or no answer to what was asked.

    `data` holds the first bytes for the log, `evidence` says what was wrong with them.
    """

    def __init__(
        self, message: str, data: bytes = b"", *, evidence: Evidence = Evidence.NOISE
    ) -> None:
        super().__init__(message)
        self.data = data[:64]
        self.evidence = evidence


class Unsteady(Garbled):
    """Two good answers that ought to be the same are not."""
