"""Modbus devices of a line, and their stations."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

from gateway.engine.device.device import Device
from gateway.planning.wire_timing import NETWORK_BAUD, WireTiming
from gateway.protocols.driver import AnyDriver
from gateway.protocols.modbus import (
    ModbusAscii,
    ModbusRtu,
    ModbusTcp,
)
from gateway.stations.modbus import ModbusStation
from gateway.tags import Tag, WriteRule
from tests.sim.bench import WIRE, Bench, Unruly
from tests.sim.plant import Plant, clock_word, made_device, make_tag

NETWORK = WireTiming(NETWORK_BAUD, 10)


Driver = ModbusRtu | ModbusAscii | ModbusTcp


def slave(
    driver: Driver,
    tags: Sequence[Tag],
    *,
    wire: WireTiming = WIRE,
    guard: float = 0.3,
    **timing: Any,
) -> Device:
    times = replace(driver.timing, **timing)
    return made_device(f"slave{driver.station}", driver, wire, times, tuple(tags), guard)


def registers(driver: AnyDriver, *sizes: int, every: float = 0.2) -> list[Tag]:
    """Blocks of holding registers of these sizes, far apart."""
    return [
        make_tag(f"holding:{number}", driver, type="uint16", every=every)
        for block, size in enumerate(sizes)
        for number in range(1000 * block, 1000 * block + size)
    ]


def writable(driver: Driver) -> tuple[Tag, Tag]:
    return (
        make_tag("holding:5", driver, type="uint16", write=WriteRule()),
        make_tag("coil:5", driver, write=WriteRule()),
    )


def station_of(driver: Driver, **settings: Any) -> ModbusStation:
    framing: Literal["rtu", "ascii", "tcp"]
    match driver:
        case ModbusRtu():
            framing = "rtu"
        case ModbusAscii():
            framing = "ascii"
        case ModbusTcp():
            framing = "tcp"
    return ModbusStation(
        station=driver.station, framing=framing, dialect=driver.addressing, **settings
    )


def plant(
    devices: Sequence[Device],
    *,
    wire: WireTiming = WIRE,
    seed: int = 0,
    bench: Bench | None = None,
    echo_in_file: bool = True,
    **station: Any,
) -> Plant:
    """Each device with its station, whose holding registers tell the time in milliseconds."""
    stations = []
    for number, device in enumerate(devices):
        inner: Any = station_of(device.driver, **station)  # type: ignore[arg-type]  # ours are Modbus
        stations.append(Unruly(inner, seed * 1000 + number, wire=wire))
        for tag in device.tags:
            if tag.address.area == "holding" and tag.write is None:
                n = tag.address.number
                inner.memory.animate("holding", n, lambda at, n=n: clock_word(at, n))
    return Plant(
        list(devices),
        stations,
        bench or Bench(seed=seed),
        wire,
        echo_in_file=echo_in_file,
    )
