"""How long characters and exchanges take on a line: what planner and time-outs reckon with."""

from dataclasses import dataclass, field

from gateway.protocols.driver import Cost, Timing

# A network connection with no wire behind it (Modbus TCP): 10 bytes per microsecond.
NETWORK_BAUD = 100_000_000


@dataclass(frozen=True, slots=True)
class WireTiming:
    """The speed of a line. Times are seconds."""

    baudrate: int = 9600
    character_bits: int = 10  # start bit, data bits, parity, stop bits
    character: float = field(init=False, compare=False)  # how long one takes

    def __post_init__(self) -> None:
        object.__setattr__(self, "character", self.character_bits / self.baudrate)

    def silence(self, timing: Timing) -> float:
        """The quiet kept before a request."""
        return max(timing.silence, timing.silence_chars * self.character)

    def exchange(self, cost: Cost, timing: Timing, turnaround: float | None = None) -> float:
        """One exchange from the silence before the request to the last character of the reply."""
        wait = timing.turnaround if turnaround is None else turnaround
        return self.silence(timing) + (cost.request + cost.reply) * self.character + wait


def character_bits(serial_format: str) -> int:
    """Bits on the wire per character of a format such as `7E1`, the start bit included."""
    data, parity, stop = int(serial_format[0]), serial_format[1], int(serial_format[2])
    return 1 + data + (parity != "N") + stop
