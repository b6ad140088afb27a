"""Durations of characters and transactions on a line, for the planner and the time-outs."""

from dataclasses import dataclass, field

from gateway.protocols.driver import Cost, Timing

# A network connection without a serial line: 10 bytes per microsecond.
NETWORK_BAUD = 100_000_000


@dataclass(frozen=True, slots=True)
class WireTiming:
    """The speed of a line. Durations are seconds."""

    baudrate: int = 9600
    character_bits: int = 10  # start bit, data bits, parity, stop bits
    character: float = field(init=False, compare=False)  # the duration of one character

    def __post_init__(self) -> None:
        object.__setattr__(self, "character", self.character_bits / self.baudrate)

    def silence(self, timing: Timing) -> float:
        """The silence kept before a request."""
        return max(timing.silence, timing.silence_chars * self.character)

    def transaction(self, cost: Cost, timing: Timing, turnaround: float | None = None) -> float:
        """The duration from the silence before the request to the last character of the reply.

        `turnaround` is the measured one; without it the protocol's default counts.
        """
        wait = timing.turnaround if turnaround is None else turnaround
        return self.silence(timing) + (cost.request + cost.reply) * self.character + wait


@dataclass(frozen=True, slots=True)
class Transactions:
    """The durations of transactions with one station. Equal for equal stations of equal lines."""

    wire: WireTiming
    timing: Timing
    turnaround: float | None = None  # the measured one; None: the default of the protocol

    def __call__(self, cost: Cost) -> float:
        """Returns the seconds of one transaction."""
        return self.wire.transaction(cost, self.timing, self.turnaround)


def character_bits(serial_format: str) -> int:
    """The bits per character on the wire of a format like `7E1`, including the start bit."""
    data, parity, stop = int(serial_format[0]), serial_format[1], int(serial_format[2])
    return 1 + data + (parity != "N") + stop
