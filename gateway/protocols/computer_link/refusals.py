"""What a Computer Link PLC says when it says no, and why it may say nothing at all."""

from gateway.errors import Refusal, Refused

# The Liyan manual prints the error code field but no list; these are Mitsubishi's.
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
    "A Computer Link PLC keeps silent, and keeps the reason in its D8063, when characters arrive "
    "damaged (6301: parity, framing or overrun; compare baud rate and character format with "
    "D8120), when a command other than the global flag goes to station FF (6305), and when a "
    "block does not end in time (6306: format 4 set in D8120 and format 1 here, a sum check "
    "expected and none sent, or a gap longer than D8129). It also keeps silent when its station "
    "number (D8121) is another."
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


def refused(station: int, code: str) -> Refused:
    """The error of a NAK block."""
    refusal, meaning = _MEANINGS.get(code, (Refusal.OTHER, "an undefined error code"))
    return Refused(f"station {station} answered NAK {code}, {meaning}", code=code, refusal=refusal)


def model_name(data: str) -> str | None:
    """`9E (FX1N)`; the codes are Mitsubishi's."""
    if len(data) != 2:
        return None
    return f"{data} ({_MODELS[data]})" if data in _MODELS else data
