"""The state file as a part: what a gateway has learned of its devices, kept across restarts.

It is read before the lines are planned, then saved regularly. It holds the addresses that each
device refuses and the places where its requests must be split, so that the search for them is made
once and not after every start. Without the file, or with a damaged one, the search is made again.
It also holds the totals of counters, which then begin again.
"""

import asyncio
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import orjson
import structlog

from gateway.engine.device.device import Device
from gateway.errors import GatewayError
from gateway.planning.bad_addresses import KnownBad
from gateway.plant.part import Core, Kind, Part
from gateway.plant.saved_file import SavedFile
from gateway.plant.threads import off_loop
from gateway.protocols.driver import Span
from gateway.tags.kept import CounterState

log = structlog.get_logger("gateway")
SAVE_EVERY = 10.0  # seconds
CLOSE_WITHIN = 0.5  # seconds; a lost state file costs only a new search
FORMAT = 1
LATEST = 2**63 - 1  # ns since 1970: the year 2262
Content = tuple[Mapping[str, KnownBad], Mapping[str, CounterState]]


class StateFile:
    """One file with what was learned of the devices."""

    def __init__(self, path: Path) -> None:
        self.counters: Mapping[str, CounterState] = {}  # as `restore` has read them
        self._file = SavedFile(path)
        self.start, self.close = self._file.start, self._file.close
        self.save, self.save_soon = self._file.save, self._file.save_soon
        self.save_last = self._file.save_last

    def load(self) -> Content:
        """Reads the file. Moves a file aside that cannot be parsed. Blocks."""
        return self._file.load(_parse) or ({}, {})

    def restore(self, devices: Iterable[Device], content: Content | None = None) -> None:
        """Restores what the file knows of the devices, and plans again those that have a plan."""
        learned_by_name, self.counters = self.load() if content is None else content
        for device in devices:
            if (learned := learned_by_name.get(device.name)) is not None:
                device.bad_addresses.restore(learned, device.tags)
                if device.blocks:
                    device.plan()

    def snapshot(
        self, devices: Iterable[Device], counters: Mapping[str, CounterState] | None = None
    ) -> bytes:
        """Returns the content of the file for the present state of the devices."""
        return orjson.dumps(
            {
                "form": FORMAT,
                "devices": {d.name: _to_json(d.bad_addresses.known()) for d in devices},
                "counters": {
                    key: list(state) for key, state in {**self.counters, **(counters or {})}.items()
                },
            },
            option=orjson.OPT_INDENT_2 | orjson.OPT_SORT_KEYS,
        )


def _parse(document: Any) -> Content:
    if document["form"] != FORMAT:
        raise ValueError(f"form {document['form']} is not {FORMAT}")
    devices = {name: _from_json(entry) for name, entry in document["devices"].items()}
    counters = {
        str(key): CounterState(_number(last), _number(total))
        for key, (last, total) in document.get("counters", {}).items()
    }
    return devices, counters


def _to_json(learned: KnownBad) -> dict[str, object]:
    return {
        "refused": [
            {"area": area, "start": start, "size": size, "since": since, "code": code}
            for (area, start, size), since, code in learned.refused
        ],
        "cuts": [[area, number] for area, number in learned.cuts],
    }


def _from_json(entry: Mapping[str, list[Mapping[str, object]]]) -> KnownBad:
    """Raises ValueError, TypeError, KeyError if the entry is damaged."""
    refused = tuple(
        (
            Span(str(row["area"]), int(str(row["start"])), int(str(row["size"]))),
            _number(str(row["since"])),
            str(row["code"]),
        )
        for row in entry["refused"]
    )
    cuts = tuple((str(area), int(number)) for area, number in entry["cuts"])
    return KnownBad(refused, cuts)


def _number(known: str | float) -> int:
    """Returns a number that can be saved again. Raises ValueError for another one."""
    number = int(known)
    if not 0 <= number <= LATEST:
        raise ValueError(f"{known} is no number from 0 to {LATEST}")
    return number


class StatePart:
    """Knowledge of the devices, and the totals of counters."""

    def __init__(self, core: Core, file: StateFile) -> None:
        self._plant = core.plant
        self._file = file

    async def restore(self) -> None:
        content = await off_loop(self._file.load)
        self._file.restore(self._plant.enabled_devices, content)
        self._plant.mirror.restore(self._file.counters)
        self._plant.doors.is_restored = True

    async def run(self) -> None:
        """Raises `GatewayError` where the file was never read: nothing may take its place."""
        if not self._plant.doors.is_restored:
            raise GatewayError("the state file was not read at the start: it is left as it was")
        self._file.start()
        try:
            while True:
                await asyncio.sleep(SAVE_EVERY)
                self._file.save_soon(self._snapshot())
        finally:
            self._file.save_last(self._snapshot())
            if not await off_loop(self._file.close, CLOSE_WITHIN):
                log.warning("state file close timed out", effect="the last changes are not saved")

    def _snapshot(self) -> bytes:
        counters = self._plant.mirror.counters()
        return self._file.snapshot(self._plant.enabled_devices, counters)


def _make(core: Core) -> Part | None:
    path = core.config.state_file
    return None if path is None else StatePart(core, StateFile(path))


KIND = Kind(_make)
