"""The settings of a modem, the states of its state machine, and what this reports."""

from dataclasses import dataclass
from enum import Enum, auto


@dataclass(frozen=True, slots=True, kw_only=True)
class ModemSettings:
    """A modem and its calls. Times in seconds. Without `number` it only answers calls."""

    number: str = ""
    init: tuple[str, ...] = ("ATZ",)
    dial_timeout: float = 60.0  # from the dial to the carrier
    tries: int = 3  # calls that fail until the modem gives up
    retry_pause: float = 10.0
    idle: float = 5.0  # without an exchange, until the call is ended
    guard: float = 1.0  # silence before and after +++
    command_timeout: float = 5.0
    hold: float = 0.1  # the longest time of the text NO CARRIER on the wire


@dataclass(slots=True)
class Pins:
    """The signals of the port."""

    dtr: bool = False  # the port has this signal
    carrier: bool = False  # the signal CD is alive, and says that the call is up


def dial_command(number: str) -> str:
    """Returns `ATDT` and the number, or `ATDP` where the number begins with P."""
    tone = "" if number[:1] in ("T", "P") else "T"
    return f"ATD{tone}{number}"


@dataclass(frozen=True, slots=True)
class Send:
    """Bytes for the modem."""

    data: bytes


@dataclass(frozen=True, slots=True)
class SetDtr:
    """Switches DTR, where there is one."""

    on: bool


@dataclass(frozen=True, slots=True)
class Ready:
    """The modem takes commands, and no call is there."""


@dataclass(frozen=True, slots=True)
class Connected:
    """The carrier is there. `text`: of the modem, such as CONNECT 9600."""

    text: str


@dataclass(frozen=True, slots=True)
class Failed:
    """The dial failed, in the words of the modem."""

    why: str


@dataclass(frozen=True, slots=True)
class Received:
    """Data of the call."""

    data: bytes


@dataclass(frozen=True, slots=True)
class Ended:
    """The call ended without our doing."""

    why: str


@dataclass(frozen=True, slots=True)
class Broken:
    """The modem does not obey: only a new opening of its port helps."""

    why: str


Event = Send | SetDtr | Ready | Connected | Failed | Received | Ended | Broken


class State(Enum):
    """Present action of the modem, as far as known."""

    CLOSED = auto()
    WAKING = auto()  # the first SETUP was sent
    PAUSING = auto()  # before the next init string
    STARTING = auto()  # an init string was sent
    READY = auto()
    DIALLING = auto()
    RINGING = auto()  # it dials a telephone, which is no modem
    ABORTING = auto()  # a dial took too long and was broken off
    ANSWERING = auto()
    ONLINE = auto()
    DROPPING = auto()  # DTR is off
    RAISED = auto()  # DTR is on again
    GUARDING = auto()  # the silence before +++
    ESCAPING = auto()  # +++ was sent
    HANGING_UP = auto()  # ATH was sent
    SAID_GONE = auto()  # its text ended the call: perhaps it was data, and the call goes on
    CARRIER_GONE = auto()  # the modem reports it; some say no OK after it
