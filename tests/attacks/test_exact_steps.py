"""At the running gateway: a value moves in steps of exactly its deadband, and to exact limits.

0.3 and 0.2 differ by 0.1, their floats by less; three times 0.1 is more than 0.3 in floats.
"""

import asyncio
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.attacks.slave import Slave, crc, program_on

MOST = 3
WALK = [*range(1, MOST + 1), *range(MOST - 1, -1, -1)]
READS = 60  # of a value, after which it has been published and carried
MOVES, CARRIED, LIMITED = 1, 11, 12  # registers


@dataclass
class Meter(Slave):
    """Its register `MOVES` holds `value`; what is written to others is kept."""

    value: int = 0
    written: dict[int, list[int]] = field(default_factory=lambda: defaultdict(list))
    news: asyncio.Event = field(default_factory=asyncio.Event)

    def _replies(self, request: bytes) -> Sequence[bytes]:
        self.news.set()
        if request[1] not in (6, 16):
            return super()._replies(request)
        first, words = int.from_bytes(request[2:4]), request[4 if request[1] == 6 else 7 : -2]
        for place in range(len(words) // 2):
            self.written[first + place].append(int.from_bytes(words[2 * place : 2 * place + 2]))
        return (request[:6] + crc(request[:6]),)

    def _word(self, number: int) -> int:
        return self.value

    async def until_carried(self) -> None:
        """Waits until the value was carried, or read so often that it is not."""
        news, last = (self.written[CARRIED], self.written[LIMITED]), len(self.requests) + READS
        while any(known[-1:] != [self.value] for known in news) and len(self.requests) < last:
            self.news.clear()
            await self.news.wait()


async def test_steps_of_exactly_the_deadband_are_published_carried_and_end_an_alarm(
    tmp_path: Path,
) -> None:
    meter = Meter(lambda n: n < 20)
    read = {"address": f"holding:{MOVES}", "type": "int16"}
    tags: dict[str, Any] = {
        "steps": {**read, "scale": 0.1, "deadband": 0.1},
        "level": {**read, "scale": 0.1, "alarm": {"high": 0.3, "hysteresis": 0.1}},
        "tenths": read,
    }
    for name, number, limits in (("carried", CARRIED, True), ("limited", LIMITED, {"max": 0.3})):
        tag = {"address": f"holding:{number}", "type": "int16", "scale": 0.1, "poll": False}
        tags[name] = {**tag, "write": limits}
    device = {"protocol": "modbus-rtu", "station": 1, "late_guard": "50ms", "tags": tags}
    more: dict[str, Any] = {"defaults": {"every": "50ms"}}
    more["transfers"] = [
        {"from": "meter/steps", "to": "meter/carried"},
        {"from": "meter/tenths", "to": "meter/limited", "scale": 0.1},
    ]
    async with program_on(meter, tmp_path, {"meter": device}, **more) as (_, client):
        values = await client.subscribe("plant/meter/steps")
        alarms = await client.subscribe("plant/@gateway/demo/alarms/meter/level")
        await values.next(lambda sample: sample.json["value"] == 0)
        for meter.value in (0, *WALK):
            await meter.until_carried()
        await client.get("plant/meter/steps")  # what was published before has arrived
    seen = [one.json["value"] for one in values.samples if one.json["quality"] == "good"]
    assert seen[-len(WALK) :] == [step / 10 for step in WALK]
    assert meter.written[CARRIED] == [0, *WALK]
    assert meter.written[LIMITED] == [0, *WALK]
    states = [(one.json["state"], one.json["value"]) for one in alarms.samples]
    assert states[-2:] == [("active", 0.3), ("returned", 0.2)]
