"""Simulated lines with Computer Link PLCs on them, for tests on virtual time."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from gateway.engine.device.device import Device
from gateway.planning.wire_timing import WireTiming
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.driver import AnyDriver
from gateway.stations.computer_link import ComputerLinkStation
from gateway.tags import Tag
from tests.sim.bench import WIRE, Bench, Unruly
from tests.sim.plant import Plant, made_device, make_tag


def link_device(
    driver: ComputerLink, *addresses: str, name: str = "", every: float = 1.0, **settings: Any
) -> Device:
    """A device with these addresses; `write` is the rule of all of them."""
    timing = {k: settings.pop(k) for k in ("reply_timeout", "retries") if k in settings}
    guard, wire = settings.pop("guard", 0.3), settings.pop("wire", WIRE)
    control = settings.pop("control", False)
    name = name or f"link{driver.station}"
    made = [make_tag(text, driver, device=name, every=every, **settings) for text in addresses]
    times = replace(driver.timing, **{"reply_timeout": 0.3, **timing})
    return made_device(name, driver, wire, times, tuple(made), guard, control=control)


def link_station(driver: AnyDriver) -> ComputerLinkStation:
    assert isinstance(driver, ComputerLink)
    return ComputerLinkStation(
        driver.station, driver.profile, driver.frame_format, driver.sum_check
    )


def link_plant(devices: Sequence[Device], wire: WireTiming = WIRE, seed: int = 0) -> Plant:
    stations = [
        Unruly(link_station(device.driver), seed * 1000 + i, wire=wire)  # type: ignore[arg-type]
        for i, device in enumerate(devices)
    ]
    return Plant(list(devices), stations, Bench(seed=seed), wire)


def commands(station: Unruly, since: float = 0.0) -> list[str]:
    """The two letters of every request to it."""
    return [data[5:7].decode("latin-1") for at, data in station.heard if at >= since]


def spelt(device: Device, text: str) -> Tag:
    return next(tag for tag in device.tags if tag.text == text)
