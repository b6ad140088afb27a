"""A device that sends its weight by itself."""

import asyncio
import random

from tests.sim.bus import Bus
from tests.sim.gadgets import Gadget
from tests.sim.judge import Judge
from tests.sim.stations import Troubled
from tests.sim.wire import SimWire


async def speak_now_and_then(
    name: str, station: Troubled, every: float, bus: Bus, judge: Judge, chance: random.Random
) -> None:
    """Sends frames about `every` seconds: its weight, and other texts now and then."""
    wire, gadget = bus.wire, station.inner
    assert isinstance(gadget, Gadget)
    assert isinstance(wire, SimWire)
    loop, character = asyncio.get_running_loop(), wire.wire.character
    while True:
        await asyncio.sleep(every * chance.uniform(0.8, 1.2))
        if station.deaf or station.mute or station.speaks or chance.random() < station.lose:
            continue
        what = chance.choice((2,) * 30 + (0, 1))
        data = gadget.speak(loop.time(), character, what)
        if chance.random() < station.cut:
            data = data[: chance.randrange(1, len(data))]
        elif chance.random() < station.junk:
            data = chance.randbytes(chance.randrange(1, 6)) + data
        elif what == 2:
            judge.said(name, gadget)
        wire.speak(data, station)
        first = wire.chunk * character
        whole = not (wire.hanging or station.junk or bus.keeps_replies(name))
        if gadget.wrapping.header and 0 < wire.chunk < len(data) and whole:
            until = loop.time() + len(data) * character
            loop.call_later(first + 1e-6, _begun, bus, until)


def _begun(bus: Bus, until: float) -> None:
    """Notes the first byte of an unsolicited frame, if the line was idle then."""
    if bus.line.engine.is_open and bus.line.engine.is_idle:
        bus.speaking = bus.now(), until
