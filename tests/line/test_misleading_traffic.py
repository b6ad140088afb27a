"""Traffic that misleads a listener: late, lost, repeated and damaged frames on a shared wire.

Each register holds a number that tells its station and address. So a reply that is taken for the
reply to another request shows at once.
"""

import random
from collections.abc import Iterator
from dataclasses import dataclass, field

from gateway.engine.device.device import Device
from gateway.engine.device.device_settings import DeviceSettings
from gateway.engine.effects import Samples
from gateway.engine.engine import Engine
from gateway.planning.wire_timing import WireTiming
from gateway.protocols.checksums import crc16
from gateway.protocols.driver import Address, Span, Timing, Unit
from gateway.protocols.modbus import ModbusRtu
from gateway.tags import Tag
from gateway.values import Layout, parse_type

WIRE = WireTiming(19200, 10)
STATIONS, ADDRESSES = (1, 2), range(16)
TIMEOUT, GUARD = 0.3, 0.6  # seconds: of the settings; a late reply arrives before the guard ends
Piece = tuple[float, bytes]


def frame(*body: int) -> bytes:
    return bytes(body) + crc16(bytes(body))


def held(station: int, address: int) -> int:
    return 1000 * station + address


@dataclass
class Traffic:
    """A master that asks for blocks of one size or of two, and stations that may be slow."""

    seed: int
    chance: random.Random = field(init=False)
    heard: list[Piece] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.chance = random.Random(self.seed)

    def pieces(self, requests: int) -> list[Piece]:
        """Returns the bytes on the wire, in their order."""
        choose, now = self.chance, 1.0
        sizes = choose.choice(([2], [2], [2, 4]))
        patience = choose.choice((0.05, 0.15, 0.3))  # of the master
        trouble = choose.choice((0.0, 0.05, 0.2, 0.5))
        free = dict.fromkeys(STATIONS, 0.0)  # when the station has sent all replies
        for _ in range(requests):
            station, size = choose.choice(STATIONS), choose.choice(sizes)
            start = choose.randrange(0, len(ADDRESSES) - size, 2)
            self._put(now, frame(station, 3, 0, start, 0, size), trouble / 4)
            took = choose.uniform(0.005, 0.03)
            if choose.random() < trouble:
                took = choose.uniform(0.1, GUARD - 0.1)
            at = max(now, free[station]) + took
            if choose.random() < trouble / 2 or at - now > GUARD - 0.05:
                now += patience  # the request or its reply is lost
                continue
            words = [held(station, start + n) for n in range(size)]
            data = b"".join(word.to_bytes(2, "big") for word in words)
            free[station] = at
            self._put(at, frame(station, 3, len(data), *data), trouble / 4)
            if choose.random() < trouble / 8:  # a device server repeats it
                self._put(at + 0.01, frame(station, 3, len(data), *data), 0.0)
            now = min(at, now + patience) + choose.choice((0.004, 0.02, 0.02, 0.7))
        return sorted(self.heard, key=lambda piece: piece[0])

    def _put(self, at: float, data: bytes, damage: float) -> None:
        """The listener may hear a frame damaged that the station understands."""
        if self.chance.random() < damage:
            place = self.chance.randrange(len(data))
            data = data[:place] + bytes((data[place] ^ 0x55,)) + data[place + 1 :]
        self.heard.append((at, data))


def learned(pieces: list[Piece]) -> Iterator[tuple[int, int, int]]:
    """Yields station, address and value of every good sample."""
    engine = Engine("hall", [device(station) for station in STATIONS], WIRE)
    engine.opened(0.0)
    for at, data in pieces:
        for effect in engine.received(data, at, 0):
            for sample in effect.samples if isinstance(effect, Samples) else ():
                if isinstance(sample.value, int):
                    yield int(sample.tag.device), sample.tag.address.number, sample.value


def device(station: int) -> Device:
    driver = ModbusRtu(station=station)
    tags = tuple(
        Tag(
            device=str(station),
            name=f"n{number}",
            text=f"holding:{number}",
            address=Address("holding", number),
            span=Span("holding", number, 1),
            unit_kind=Unit.WORD,
            layout=Layout(parse_type("uint16")),
        )
        for number in ADDRESSES
    )
    return Device(
        DeviceSettings(
            name=str(station),
            driver=driver,
            timing=Timing(reply_timeout=TIMEOUT),
            late_guard=GUARD - TIMEOUT,
            listen_only=True,
            tags=tags,
        ),
        WIRE,
    )


def test_no_value_of_another_address_is_ever_learned() -> None:
    """14,000 seeds, with 1,100,000 values, were run once: `learned(Traffic(seed).pieces(60))`."""
    found = 0
    for seed in range(80):
        for station, address, value in learned(Traffic(seed).pieces(60)):
            assert value == held(station, address), f"seed {seed}"
            found += 1
    assert found > 1000


def test_quiet_traffic_is_learned_whole() -> None:
    whole = [
        piece
        for n in range(50)
        for piece in (
            (1.0 + n * 0.05, frame(1, 3, 0, 0, 0, 2)),
            (1.02 + n * 0.05, frame(1, 3, 4, 3, 0xE8, 3, 0xE9)),
        )
    ]
    assert len(list(learned(whole))) == 100
