"""Devices whose words hold the time, so that a test can tell how old a value is."""

from typing import Any

from gateway.engine.device.device import Device
from gateway.tags import Tag
from tests.sim.plant import Plant, clockwork, device, words


def clocks(*sizes: int, station: int = 1, every: float = 0.5, **settings: Any) -> Device:
    """A device with blocks of these sizes, far apart."""
    name = f"plc{station}"
    tags: list[Tag] = []
    for number, size in enumerate(sizes):
        tags += words(1000 * number, size, device=name, every=every)
    return device(tags, station=station, name=name, **settings)


def wind_up(plant: Plant) -> None:
    for dev, station in zip(plant.devices, plant.stations, strict=True):
        clockwork(station.memory, [tag.address.number for tag in dev.tags])
