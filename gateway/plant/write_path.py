"""The writes and commands of clients: found a line, checked, and passed to it."""

import asyncio
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from gateway.engine.device.device import Device
from gateway.engine.jobs.requests import WRITE_EXPIRY, CommandResult
from gateway.errors import Busy, GatewayError, Offline
from gateway.line.groups import ended, not_acknowledged
from gateway.line.line import Line
from gateway.plant.any_address import AnyAddress
from gateway.tags import Tag, WriteResult
from gateway.values import Value


class Store(Protocol):
    """Tags whose values no device has: a part keeps what clients write."""

    def holds(self, tag: Tag) -> bool: ...

    async def write_group(self, values: Sequence[tuple[Tag, Value]]) -> Sequence[WriteResult]:
        """Raises `BadValue` and `Busy` before anything changed."""


@dataclass(eq=False)
class WritePath:
    """Writes and commands. Each raises `BadValue` before anything is sent, and otherwise a
    `GatewayError`."""

    _places: Mapping[str, tuple[Line, Device]]
    _tags: Mapping[str, Tag]
    any_address: AnyAddress
    _stores: Sequence[Store]
    _wall: Callable[[], int]

    async def write_group(
        self,
        values: Sequence[tuple[Tag, Value]],
        within: float = WRITE_EXPIRY,
        patience: float = WRITE_EXPIRY,
    ) -> Sequence[WriteResult | GatewayError]:
        """Writes tags of one device in their order; returns the outcome of each.

        What has not ended after `patience` seconds is `Unclear`. It raises when nothing was sent.
        """
        first = values[0][0]
        place = self._places.get(first.device)
        for tag, _ in values:  # its scale or limits may be others now
            if self._tags.get(tag.key) is not tag and not self._is_target(tag, place):
                raise Busy(f"the file was reloaded, and {tag.key} with it; not sent")
        if (store := next((one for one in self._stores if one.holds(first)), None)) is not None:
            try:
                async with asyncio.timeout(patience):
                    return await store.write_group(values)
            except TimeoutError:
                raise not_acknowledged(patience) from None
        line, device = self._place(first.device)
        units = [(tag, tag.encode(value)) for tag, value in values]
        return await ended(line.write_group(device, units, within), patience)

    async def control(
        self, device: str, command: str, argument: str, within: float
    ) -> CommandResult:
        """Returns the reply of the device."""
        line, receiver = self._place(device)
        loop = asyncio.get_running_loop()
        started = loop.time()
        answer = await line.command(receiver, command, argument, within)
        return CommandResult(answer, self._wall(), loop.time() - started)

    def dialling(self, device: str) -> float:
        """Returns the seconds that a request may wait for a telephone call; 0: for none."""
        place = self._places.get(device)
        return 0.0 if place is None else place[0].dialling

    def _is_target(self, tag: Tag, place: tuple[Line, Device] | None) -> bool:
        settings = None if place is None else place[1].settings
        return settings is not None and (
            tag in settings.targets or self.any_address.is_target(tag, settings.driver)
        )

    def _place(self, device: str) -> tuple[Line, Device]:
        if device not in self._places:
            raise Offline(f"device {device} is disabled; nothing was sent")
        return self._places[device]
