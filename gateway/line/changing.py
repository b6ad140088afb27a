"""Changed devices on their way to a line."""

import asyncio
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

from gateway.engine.device.changes import Changes
from gateway.engine.device.device_settings import DeviceSettings


@runtime_checkable
class Changeable(Protocol):
    """A simulated port, whose stations are the devices of the file."""

    def change(self, devices: Sequence[DeviceSettings]) -> None: ...


class WaitingChange(NamedTuple):
    """Changed devices that wait for the end of the current transaction."""

    changes: Changes
    devices: Sequence[DeviceSettings]  # all of the line
    applied: Callable[[], None]
    ended: asyncio.Future[None]
