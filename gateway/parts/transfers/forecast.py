"""Forecasts the lines with their transfers: the load, and how old a carried value can be."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from gateway.config import Config
from gateway.engine.device.device import Device
from gateway.engine.forecast import LineForecast, TimedWrites, write_seconds
from gateway.plant.expected import polls_of
from gateway.tags import Tag
from gateway.tags.transfer import TransferRule, leaves


@dataclass(frozen=True, slots=True)
class TransferForecast:
    """One row. Times in seconds."""

    rule: TransferRule
    line: str  # of the target; empty for a value that a master reads
    writes: TimedWrites
    worst_age: float | None  # of the value when the target has it; None: no poll reads the source

    @property
    def load(self) -> float:
        """The share of the wire time of the line."""
        return self.writes.often * self.writes.seconds


def forecasts(
    config: Config, report: Callable[[str, float], None] | None = None
) -> list[LineForecast]:
    """Calculates the load and the worst ages of each polled line, with its transfers.

    `report` receives the name of this step and the share of it that is done.
    """
    found = polls_of(config, report)
    return with_transfers(found, transfer_forecasts(config, found))


def transfer_forecasts(config: Config, lines: Sequence[LineForecast]) -> list[TransferForecast]:
    """Returns the rows of the file. `lines`: the polled lines that are planned."""
    if not config.transfers:
        return []
    rules = config.transfers
    tags = _tags(config, {key for rule in rules for key in (rule.source, rule.target)})
    needed = {leaf for rule in rules if rule.source in tags for leaf in leaves(tags[rule.source])}
    polls = {
        tag: row for line in lines for row in line.blocks for tag in row.block.tags if tag in needed
    }
    latest = {line.name: line.worst_write for line in lines}
    places = _places(config, lines, {tag.device for tag in tags.values()})
    found = []
    for rule in rules:
        if rule.source not in tags or rule.target not in tags:
            continue  # of a device that another gateway serves
        source, target = tags[rule.source], tags[rule.target]
        line, device = places.get(target.device, ("", None))
        seconds = 0.0 if device is None else write_seconds(device, target)
        read = [polls[one] for one in leaves(source) if one in polls]
        age = None
        if read:
            age = max(row.worst_age for row in read)
            age += (rule.every or 0.0) + latest.get(line, 0.0)
        changes = min((row.block.every for row in read), default=source.every)
        often = 1 / (rule.every or changes)  # at most: it changes with each read
        found.append(TransferForecast(rule, line, TimedWrites(often, seconds), age))
    return found


def _places(
    config: Config, lines: Sequence[LineForecast], names: set[str]
) -> dict[str, tuple[str, Device]]:
    """Returns these devices with their lines."""
    polled = {row.device.name: row.device for line in lines for row in line.blocks}
    planned = {line.name for line in lines}
    return {
        one.name: (line.name, polled.get(one.name) or Device(one, line.wire, plan_now=False))
        for line in config.lines
        if line.name in planned
        for one in line.devices
        if one.enabled and one.name in names
    }


def _tags(config: Config, keys: set[str]) -> dict[str, Tag]:
    """Returns the tags with these keys."""
    devices = {key.partition("/")[0] for key in keys}
    names = {key.partition("/")[2] for key in keys}  # quicker than to make each key
    return {
        tag.key: tag
        for one in config.devices
        if one.name in devices
        for tag in (*one.tags, *one.targets)
        if tag.name in names and tag.key in keys
    }


def with_transfers(
    lines: Sequence[LineForecast], rows: Sequence[TransferForecast]
) -> list[LineForecast]:
    """Returns the lines with the writes of the rows."""
    return [
        line.with_writes([row.writes for row in rows if row.line == line.name]) for line in lines
    ]
