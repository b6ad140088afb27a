"""Parts of a plant, made as the service makes them."""

from collections.abc import Callable
from typing import Any, TypeVar

from gateway.parts.alarms.part import AlarmPart
from gateway.parts.registry import kinds
from gateway.plant.plant import Plant
from gateway.service.bulkheads import Bulkheads

T = TypeVar("T")


class Silent:
    """The side of Zenoh: nothing is published there, and nothing may be written."""

    is_ready = True

    def publish_latest(self, path: str, make: Callable[[], bytes]) -> None:
        make()

    async def documents(self, _max_age: float) -> Any:
        return {"status": {"refused_devices": {}}}

    async def write_own(self, *_: object) -> Any:
        raise AssertionError("no part of this test writes")


def parts_of(plant: Plant, *names: str, north: Any = None) -> Bulkheads:
    """Returns the parts with these names."""
    parts = Bulkheads(plant)
    plant.subscribe(parts)
    silent: Any = Silent()
    parts.make(
        [(name, kind) for name, kind in kinds() if name in names],
        silent if north is None else north,
    )
    return parts


def find(parts: Bulkheads, part: type[T]) -> T:
    [found] = parts.each(part)
    assert isinstance(found, part)
    return found


def alarms_of(plant: Plant) -> AlarmPart:
    return find(parts_of(plant, "alarms"), AlarmPart)
