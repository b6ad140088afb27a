"""A reload is refused as a whole, and says why."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from gateway.config import load
from gateway.plant.plant import Plant
from gateway.service.reload import LiveReload, Reloader, RunningLines
from gateway.service.supervisor import Supervisor
from tests.parts.made import parts_of
from tests.reload.plant import Data, file, vigor
from tests.sim.virtual import on_virtual_time


class Claiming:
    """The claims of a gateway whose neighbour serves one device."""

    withheld: Mapping[str, str] = {}

    def taken(self, devices: Iterable[str]) -> Mapping[str, str]:
        return {"press": "other"} if "press" in devices else {}

    async def change(self, devices: Iterable[str]) -> None:
        raise AssertionError("nothing may be claimed")


def write(path: Path, **devices: Data) -> Path:
    path.write_text(json.dumps(file(hall=devices)))
    return path


@on_virtual_time
async def test_a_device_of_another_gateway_is_refused_and_nothing_changes(tmp_path: Path) -> None:
    path = write(tmp_path / "c.yaml", mixer=vigor(1))
    gateway = Plant(load(path))
    before = gateway.config
    reloader, lines = Reloader(path, before), RunningLines()
    north: Any = SimpleNamespace(admission=SimpleNamespace(claiming=Claiming()))
    live = LiveReload(reloader, gateway, north, lines, (), Supervisor({}), parts_of(gateway))
    config = load(write(path, press=vigor(3), mixer=vigor(1)))
    await live._reload(config)  # its only caller waits for a signal
    assert gateway.config is before
    assert reloader.document()["why"] == ["device press belongs to gateway other"]
    assert reloader.document()["reloads"] == 0


async def test_a_part_that_needs_a_restart_refuses_the_whole_file(tmp_path: Path) -> None:
    path = write(tmp_path / "c.yaml", mixer=vigor(1))
    reloader = Reloader(path, load(path))
    data = file(hall={"mixer": vigor(2)})
    data["zenoh"]["prefix"] = "other"
    path.write_text(json.dumps(data))
    reloader.want()
    assert await reloader.next() is None
    assert reloader.document()["why"] == [f"{path}: zenoh.prefix changed: this needs a restart"]
    data["zenoh"]["prefix"] = "plant"
    path.write_text(json.dumps(data))
    reloader.want()
    assert await reloader.next() is not None
