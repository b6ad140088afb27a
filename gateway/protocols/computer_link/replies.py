"""The replies of a Computer Link PLC: acceptance, error codes, and causes of no reply."""

from collections.abc import Callable
from typing import TypeVar

from gateway.errors import Refusal, Refused
from gateway.protocols.computer_link.codec import PC, PC_ON_DEMAND, Ack, Enquiry, Frame, Nak, Text

T = TypeVar("T")

# The Liyan manual prints the error code field but no list; these are Mitsubishi's.
_UNEXECUTED = ("02", "03", "0A", "10")  # errors of the block itself, before its devices are used
_MEANINGS = {
    "02": (Refusal.DAMAGED, "sum check error"),
    "03": (Refusal.OTHER, "protocol error: the PLC expects another format, or has no such command"),
    "06": (Refusal.ADDRESS, "character area error: no such device, range or count"),
    "07": (Refusal.OTHER, "character error: the data written is not hexadecimal"),
    "0A": (Refusal.OTHER, "PC number error"),
    "10": (Refusal.OTHER, "PC number error"),
    "18": (Refusal.OTHER, "remote run or stop is not possible now"),
}

NO_REPLY_CAUSES = (
    "A Computer Link PLC does not reply, and stores the reason in D8063, when characters arrive "
    "damaged (6301: parity, framing or overrun; compare baud rate and character format with "
    "D8120), when a command other than the global flag goes to station FF (6305), and when a "
    "block does not end in time (6306: format 4 set in D8120 and format 1 here, a sum check "
    "expected and none sent, or a gap longer than D8129). It also does not reply when its station "
    "number (D8121) is another."
)

AREA_C_ECHO = (
    "the echo of this acknowledgement is equal to the acknowledgement of a write by the PLC: "
    "leave it out, no known PLC needs it"
)

_MODELS = {
    "F2": "FX1S",
    "8E": "FX0N",
    "8D": "FX or FX2C",
    "9E": "FX1N",
    "9D": "FX2N",
    "F3": "FX3U",
    "F4": "FX3G",
}


def accept_text(station: int, decode: Callable[[str], T | None]) -> Callable[[Frame], T | None]:
    """Accepts data of the station; `decode` returns None for data of another request."""

    def accept(frame: Frame) -> T | None:
        answer = _answer(frame, station)
        return decode(answer.data) if isinstance(answer, Text) else None

    return accept


def accept_ack(station: int) -> Callable[[Frame], bool | None]:
    """Accepts the acknowledgement of the station."""

    def accept(frame: Frame) -> bool | None:
        return True if isinstance(_answer(frame, station), Ack) else None

    return accept


def _answer(frame: Frame, station: int) -> Frame | None:
    """Returns a reply of the station; None for another frame. Raises `Refused`."""
    if frame.station != station or frame.pc != PC:
        return None
    if isinstance(frame, Nak):
        refusal, meaning = _MEANINGS.get(frame.code, (Refusal.OTHER, "an undefined error code"))
        raise Refused(
            f"station {station} answered NAK {frame.code}, {meaning}",
            code=frame.code,
            refusal=refusal,
            unexecuted=frame.code in _UNEXECUTED,
        )
    return frame


def model_name(data: str) -> str | None:
    """Returns `9E (FX1N)`; the codes are Mitsubishi's."""
    if len(data) != 2:
        return None
    return f"{data} ({_MODELS[data]})" if data in _MODELS else data


def describe_stray(frame: Frame) -> str | None:
    """Explains on-demand data of a PLC, and the echo of a request."""
    match frame:
        case Text(station, data, pc) if pc == PC_ON_DEMAND:
            return f"on-demand data of station {station}: {data}"
        case Enquiry(_, command, area):
            return f"echo of {command} {area}"
    return None
