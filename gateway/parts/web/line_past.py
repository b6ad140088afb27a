"""The past of the lines for the page: their loads, and a timeline of their states."""

import asyncio
import re
import time
from collections import deque
from collections.abc import Mapping
from itertools import islice

from gateway.contract.faults import Documents, below, causes
from gateway.plant.part import Core

LOAD_EVERY = 5.0  # seconds; as often as the status is published: it costs nothing more
KEPT_LOADS = 360  # half an hour
KEPT_STATES = 50
_LONGEST = 200  # characters of a cause
_CHANGING = re.compile(r" \(for [^)]*\)|, [^:,]* to \d+% of the last \d+ requests")
Timeline = tuple[tuple[int, str, str], ...]  # ms; well, starting, warning, wrong; its cause


class Loads:
    """The load of each line in the last half hour, and its states since the gateway started.

    Of each line the last `KEPT_STATES` are kept, each with its first cause. It is measured also
    while no page is open.
    """

    def __init__(self, core: Core) -> None:
        self._north = core.north
        self._last: Mapping[str, float] = {}
        self._at = 0.0
        self._loads: dict[str, deque[float]] = {}
        self.number = 0  # of measurements
        self.timelines: dict[str, Timeline] = {}

    async def run(self) -> None:
        """Runs until cancelled."""
        while True:
            documents = await self._north.documents(LOAD_EVERY)
            self.take(documents)
            self.note(documents, time.time_ns() // 10**6)
            await asyncio.sleep(LOAD_EVERY)

    def since(self, number: int) -> dict[str, list[float]]:
        """Returns the loads of each line after that measurement."""
        new = min(self.number - number, KEPT_LOADS)
        return {
            name: [*islice(loads, max(0, len(loads) - new), None)]
            for name, loads in self._loads.items()
        }

    def take(self, documents: Documents) -> None:
        up = documents["status"]["up"]
        busy = {name: one["busy_time"] for name, one in below("lines/", documents)}
        if (passed := up - self._at) <= 0:
            return  # the same documents
        for name, seconds in busy.items():
            if (before := self._last.get(name)) is not None:
                load = min(1.0, max(0.0, (seconds - before) / passed))
                self._loads.setdefault(name, deque(maxlen=KEPT_LOADS)).append(round(load, 3))
        self.number += 1
        self._last, self._at = busy, up

    def note(self, documents: Documents, now: int) -> None:
        """Notes the state of each line where it differs from the one before. `now`: ms.

        While a device starts, the state before goes on: a silent line that is opened again is not
        well.
        """
        known, self.timelines = self.timelines, {}
        for name, (faults, warnings) in causes(documents).items():
            kind = "wrong" if faults else "warning" if warnings else "well"
            cause = _CHANGING.sub("", next(iter([*faults, *warnings]), ""))[:_LONGEST]
            states = known.get(name, ())
            line = documents[f"lines/{name}"]
            opens = not line["open"] and not line["trouble"]
            if opens or (kind == "well" and "starting" in line["devices"].values()):
                kind, cause = "starting", ""
            if not states or (kind != "starting" and states[-1][1:] != (kind, cause)):
                states = (*states[1 - KEPT_STATES :], (now, kind, cause))
            self.timelines[name] = states
