"""The ports of the bench: it lists and scans them, and reads registers again and again."""

import asyncio
from collections.abc import Coroutine, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

from gateway.cli.bench.draft import largest_area
from gateway.cli.bench.running import Running
from gateway.cli.config.new import NamedStation, serial_ports
from gateway.cli.line import direct
from gateway.cli.line import scan as scanning
from gateway.cli.line.peek import View, asked, names_at, only, view_of
from gateway.cli.line.peek_table import Column, columns_of, shown_in
from gateway.cli.line.scan_command import noises
from gateway.config import Config
from gateway.errors import ConfigError, GatewayError
from gateway.planning.wire_timing import WireTiming, character_bits
from gateway.protocols.driver import Address, Unit
from gateway.simulator.plant import station_for
from gateway.simulator.serve import Served, serve_on_tcp
from gateway.tags.unit_tag import unit_tag
from gateway.transport import SerialSettings, parse_port
from gateway.values import Layout

SIMULATED = "simulated"
_STATIONS = (1, 2, 5)  # of a simulated line
_MOVING = 20  # words of each that move; the others keep what is written
EVERY = 0.4  # seconds
_ASKED_FOR = 10.0  # seconds that registers are read for a page that has gone
_ALL = 10_000  # characters: every column


class Scan:
    """The scan of a port, and what it found: also before it was stopped, or lost the port."""

    def __init__(self) -> None:
        self.port = self.error = self._what = ""
        self.simulated = False
        self.report = scanning.Report()
        self._share = 0.0
        self._served: dict[str, Served] = {}  # by protocol
        self._task: asyncio.Task[None] | None = None

    @property
    def runs(self) -> bool:
        return self._task is not None and not self._task.done()

    async def start(self, options: Mapping[str, str], config: Config | None) -> None:
        """Starts it. `options` as those of the command; `config`: of a gateway that runs, whose
        ports are its own. Raises `ConfigError`."""
        if self.runs:
            raise ConfigError("a scan runs already")
        port, protocol = options.get("port", ""), options.get("protocol", "")
        self.simulated = port == SIMULATED
        if self.simulated:
            port = await self._simulate(protocol)
        names = ("stations", "baud", "format", "timeout")
        stations, bauds, formats, timeout = (options.get(name) or None for name in names)
        plan = scanning.planned(port, protocol, stations, bauds, formats, timeout or "200ms")
        for line in () if config is None else config.lines:
            if line.port == parse_port(port):
                raise ConfigError(f"the gateway has this port open: it is line {line.name}")
        self.port, self.error, self.report = port, "", scanning.Report()
        self._what, self._share = "", 0.0
        self._task = asyncio.create_task(self._run(plan), name="scan")

    async def _run(self, plan: scanning.Plan) -> None:
        try:
            await scanning.scan(plan, share=self._progress, report=self.report)
            if not self.report.found:
                self.error = f"no station replied at {self.port}"
        except GatewayError as error:
            self.error = str(error)

    def _progress(self, what: str, share: float) -> None:
        self._what, self._share = what, share

    def chosen(self, names: Mapping[str, str]) -> list[NamedStation]:
        """Returns the stations that have a name. Raises `ConfigError`."""
        found = [
            NamedStation(name, one)
            for one in self.report.found
            if (name := names.get(str(one.driver.station)))
        ]
        if not found:
            raise ConfigError("name a station that replied")
        return found

    def document(self) -> dict[str, Any]:
        return {
            "runs": self.runs,
            "what": self._what,
            "share": self._share,
            "error": self.error,
            "noises": [*noises(self.report)],
            "port": self.port,
            "at": scanning.spoken(self.report.found[0].serial) if self.report.found else "",
            "found": [
                {"station": one.driver.station, "refusal": one.refusal, **one.settings}
                for one in self.report.found
            ],
        }

    async def stop(self) -> None:
        """Ends the scan before it has asked all, and closes the port."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    async def close(self) -> None:
        await self.stop()
        for served in self._served.values():
            await served.close()

    async def _simulate(self, protocol: str) -> str:
        """Serves stations of a protocol until the bench ends. Returns their port."""
        if protocol in self._served:
            return self._served[protocol].address
        stations = []
        for number in _STATIONS:
            driver = next(iter(scanning.variants(protocol, number)))[0]
            area = driver.areas[largest_area(driver)]
            tags = [
                unit_tag("", driver, Address(area.name, area.first + at), "", 1.0)
                for at in range(_MOVING)
            ]
            stations.append(station_for(driver, tags))
        serial = SerialSettings(19200, driver.traits.format)
        wire = WireTiming(serial.baudrate, character_bits(serial.format))
        paced = not driver.traits.over_network
        served = await serve_on_tcp(stations, wire, "127.0.0.1", 0, paced=paced)
        self._served[protocol] = served
        return served.address

    def serial_ports(self) -> list[str]:
        return serial_ports()


class Registers:
    """The registers of one device, read while a page asks for them."""

    def __init__(self, running: Running) -> None:
        self._running = running
        self._view: View | None = None
        self._columns: list[Column] = []
        self._range = ""
        self._asked = 0.0
        self._task: asyncio.Task[None] | None = None
        self._error = ""
        self._turn = asyncio.Lock()  # two looks at once would be two masters

    async def look(self, config: Config, device: str, text: str) -> None:
        """Reads another range from now on. Raises `ConfigError`."""
        async with self._turn:
            await self._end()
            view = view_of(only(config, device), text, EVERY)
            order = view.driver.traits.string_order
            bit = Column("bit", 1, lambda words: str(words[0]))
            words = view.unit is not Unit.BIT
            self._columns = columns_of(view.unit, order, _ALL) if words else [bit]
            reading = self._reading(view, device, text)
            self._range = text
            self._view, self._error, self._asked = view, "", asyncio.get_running_loop().time()
            self._task = asyncio.create_task(self._guarded(reading), name="registers")

    def _reading(self, view: View, device: str, text: str) -> Coroutine[Any, Any, None]:
        """Returns what reads them: by the gateway, or at the port if that is free. Raises
        `ConfigError`."""
        config = self._running.config if self._running.state else None
        lines = () if config is None else config.lines
        if any(one.name == device for line in lines for one in line.devices):
            return self._poll(view, text)
        if any(line.port == view.config.lines[0].port for line in lines):
            raise ConfigError(f"the gateway has the port of {device} open: apply the file first")
        return direct.follow(view.config, view)

    async def _guarded(self, reading: Coroutine[Any, Any, None]) -> None:
        """Reads until no page has asked for a while."""
        loop = asyncio.get_running_loop()
        task = asyncio.create_task(reading)
        try:
            while not task.done() and loop.time() - self._asked < _ASKED_FOR:
                await asyncio.wait([task], timeout=1.0)
            if task.done():
                task.result()
        except GatewayError as error:
            self._error = str(error)
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    async def _poll(self, view: View, text: str) -> None:
        while True:
            question = partial(asked, view=view, text=text)
            view.samples(await self._running.ask(question))
            await asyncio.sleep(EVERY)

    def document(self, config: Config) -> dict[str, Any]:
        """Returns the rows. `config`: with the names that tags have now."""
        self._asked = asyncio.get_running_loop().time()
        if (view := self._view) is None:
            return {"device": "", "columns": [], "rows": [], "error": self._error, "reads": False}
        device = view.tags[0].device
        with suppress(ConfigError):
            (line,) = only(config, device).lines
            view.names = names_at(line.devices[0].tags, view.tags[0].span.area)
        cells = [view.cell(tag) for tag in view.tags]
        return {
            "device": device,
            "columns": [column.title for column in self._columns],
            "rows": [
                {
                    "address": cell.address,
                    "raw": cell.raw,
                    "changed": cell.changed,
                    "note": cell.note,
                    "cells": [shown_in(column, cells, at) for column in self._columns],
                }
                for at, cell in enumerate(cells)
            ],
            "error": self._error,
            "reads": self._task is not None and not self._task.done(),
        }

    @property
    def looked_at(self) -> tuple[str, str] | None:
        """The device and the range."""
        return None if self._view is None else (self._view.tags[0].device, self._range)

    async def close(self) -> None:
        async with self._turn:
            await self._end()

    async def _end(self) -> None:
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
            self._task = None
        self._view = None


def values(config: Config, rows: Sequence[Any], most: int) -> list[dict[str, Any]]:
    """Returns the values of the gateway, with what a person needs to write them."""
    known = {tag.key: tag for device in config.devices for tag in device.tags}
    found = []
    for row in rows[:most]:
        tag = known.get(row.tag)
        if tag is None:
            continue
        rule = tag.write
        found.append(
            {
                "tag": row.tag,
                **{name: row.document.get(name) for name in ("value", "quality", "reason", "text")},
                "unit": tag.label.unit,
                "write": None if rule is None else {"min": rule.min, "max": rule.max},
                "verify": rule is not None and rule.verify,
            }
        )
    return found


__all__ = ["Layout", "Registers", "Scan", "values"]
