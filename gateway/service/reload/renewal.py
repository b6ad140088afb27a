"""Takes over the difference between two configurations, while all other devices go on.

Everything that takes long is made on a thread. Each line takes over its changes between two
transactions. First the changed devices leave their lines, then they arrive: one may move. The task
of a line is started and ended here.
"""

import asyncio
from collections.abc import Coroutine, Mapping

from gateway.config import LineConfig
from gateway.config.changes import DeviceChange, Difference
from gateway.engine.device.changes import Changes
from gateway.engine.device.device import Device
from gateway.engine.forecast import forecast
from gateway.line.line import Line
from gateway.planning.bad_addresses import KnownBad
from gateway.plant.plant import Plant
from gateway.plant.threads import off_loop
from gateway.tags import Tag


class RunningLines:
    """One task for each line. `failed` is set when one ends by itself."""

    def __init__(self) -> None:
        self.failed = asyncio.Event()
        self.started = False
        self._tasks: dict[object, asyncio.Task[None]] = {}  # by line

    def start(self, line: object, name: str, work: Coroutine[None, None, None]) -> None:
        """Starts the task `work` of a line, which may plan it first."""
        self.started = True
        task = asyncio.create_task(work, name=name)
        self._tasks[line] = task
        task.add_done_callback(lambda ended: self._ended(line, ended))

    async def end(self, line: object) -> None:
        """Ends the line. Returns when its port is closed."""
        task = self._tasks.pop(line)
        task.cancel()
        await asyncio.wait([task])

    async def end_all(self) -> None:
        """Ends every line. Raises the error of one that failed."""
        tasks, self._tasks = [*self._tasks.values()], {}
        for task in tasks:
            task.cancel()
        for outcome in await asyncio.gather(*tasks, return_exceptions=True):
            if isinstance(outcome, Exception):
                raise outcome

    def _ended(self, line: object, task: asyncio.Task[None]) -> None:
        if self._tasks.get(line) is task:
            self.failed.set()


class Renewal:
    """One reload of a running gateway."""

    def __init__(self, plant: Plant, lines: RunningLines, difference: Difference) -> None:
        self._plant = plant
        self._lines = lines
        self._difference = difference
        self._source = {
            d.name: line.engine.name for line in plant.lines for d in line.engine.devices
        }
        self._target = {
            device.name: line.name
            for line in difference.config.lines
            for device in line.devices
            if device.enabled
        }
        self._made: Mapping[str, Device] = {}  # with a plan, for lines that stay open

    async def run(self) -> None:
        """Returns when every line has taken over its changes."""
        plant, difference = self._plant, self._difference
        running = {device.name: device for line in plant.lines for device in line.engine.devices}
        known = {
            change.name: (running[change.name], running[change.name].bad_addresses.known())
            for change in difference.devices.values()
            if change.continues
        }
        self._made = await off_loop(self._make, known)
        plant.take_over(
            [
                change
                for change in difference.devices.values()
                if change.name not in self._source and change.name not in self._target
            ]
        )
        await asyncio.gather(*[self._leave(line) for line in plant.lines])
        stay = [*plant.lines]
        await asyncio.gather(
            *(self._arrive(line) for line in stay), *(self._open(one) for one in difference.opened)
        )
        plant.configure(difference.config)
        plant.compute(difference.computed.started, difference.computed.gone)

    def _make(self, known: Mapping[str, tuple[Device, KnownBad]]) -> Mapping[str, Device]:
        """Makes and plans the devices of lines that stay open. On a thread."""
        wires = {line.engine.name: line.engine.wire for line in self._plant.lines}
        for one in self._difference.opened:
            wires.pop(one.name, None)
        made = {}
        for change in self._difference.devices.values():
            wire = wires.get(self._target.get(change.name, ""))
            if change.new is None or wire is None:
                continue
            if change.continues:
                old, bad = known[change.name]
                device = old.successor(change.new, bad)
            else:
                device = Device(change.new, wire, plan_now=False)
            device.plan()
            made[change.name] = device
        return made

    async def _leave(self, line: Line) -> None:
        """Takes the changed devices off the line. Those that stay on it come back at once."""
        name = line.engine.name
        closed = name in self._difference.closed
        removed, added, replaced = list[Device](), list[Device](), list[tuple[Device, Device]]()
        changes = list[DeviceChange]()
        for device in line.engine.devices:
            if (change := self._difference.devices.get(device.name)) is None:
                continue
            changes.append(change)
            if change.continues:
                replaced.append((device, self._made[device.name]))
                continue
            removed.append(device)
            if not closed and self._target.get(device.name) == name:
                added.append(self._made[device.name])
        if changes:
            await self._change(line, changes, Changes(removed, added, replaced, _renewed(changes)))
        if closed:
            await self._lines.end(line)
            self._plant.remove_line(line)

    async def _arrive(self, line: Line) -> None:
        """Adds the devices that were on no line, or on another one."""
        name = line.engine.name
        arriving = [c for c in self._on(name) if self._source.get(c.name) != name]
        if arriving:
            added = [self._made[change.name] for change in arriving]
            await self._change(line, self._new(arriving), Changes(added=added))

    async def _open(self, config: LineConfig) -> None:
        plant = self._plant
        plant.take_over(self._new(self._on(config.name)))
        line = plant.add_line(config)
        plant.planned(line, await off_loop(plant.plan, line))
        self._lines.start(line, config.name, line.run())

    async def _change(self, line: Line, tags: list[DeviceChange], changes: Changes) -> None:
        plant, engine = self._plant, line.engine
        here = [*changes.added, *(new for _, new in changes.replaced)]

        def applied() -> None:
            plant.move([device.name for device in changes.removed], line, here)
            plant.take_over(tags)

        settings = {one.name: one.devices for one in self._difference.config.lines}
        await line.change(changes, settings.get(engine.name, ()), applied)
        devices = [*engine.devices]
        plant.expect(await off_loop(forecast, engine.name, devices, engine.wire))

    def _on(self, line: str) -> list[DeviceChange]:
        """Returns the changes of enabled devices that the line has from now on."""
        changes = self._difference.devices.values()
        return [change for change in changes if self._target.get(change.name) == line]

    def _new(self, changes: list[DeviceChange]) -> list[DeviceChange]:
        """Returns the changes whose tags were not taken over when their device left a line."""
        return [change for change in changes if change.name not in self._source]


def _renewed(changes: list[DeviceChange]) -> dict[Tag, Tag]:
    return {old: new for change in changes for old, new in change.renewed.items()}
