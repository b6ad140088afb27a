"""Writes one tag as the parts do: the only one of its group."""

from collections.abc import Sequence
from typing import Protocol

from gateway.engine.jobs.requests import WRITE_EXPIRY
from gateway.errors import GatewayError
from gateway.tags import Tag, WriteResult
from gateway.values import Value


class Writer(Protocol):
    async def write_group(
        self, values: Sequence[tuple[Tag, Value]], within: float, patience: float
    ) -> Sequence[WriteResult | GatewayError]: ...


async def write(plant: Writer, tag: Tag, value: Value, within: float = WRITE_EXPIRY) -> WriteResult:
    """Returns when the device has acknowledged. Raises `GatewayError`."""
    [end] = await plant.write_group([(tag, value)], within, 60.0)
    if isinstance(end, GatewayError):
        raise end
    return end
