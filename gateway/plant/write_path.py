"""The requests of clients: found a line, checked, and passed to it."""

import asyncio
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from gateway.engine.device.device import Device
from gateway.engine.jobs.requests import WRITE_EXPIRY, CommandResult, Peeked
from gateway.errors import BadValue, Busy, ConfigError, GatewayError, Offline
from gateway.line.groups import ended, not_acknowledged
from gateway.line.line import Line
from gateway.protocols.driver import Address
from gateway.protocols.ranges import addresses, spans
from gateway.tags import Tag, WriteResult
from gateway.values import Value

MOST_PEEKED = 256  # addresses of one peek


class Store(Protocol):
    """Tags whose values no device has: a part keeps what clients write."""

    def holds(self, tag: Tag) -> bool: ...

    async def write_group(self, values: Sequence[tuple[Tag, Value]]) -> Sequence[WriteResult]:
        """Raises `BadValue` and `Busy` before anything changed."""


@dataclass(eq=False)
class WritePath:
    """Writes, commands and peeks. Each raises `BadValue` before anything is sent, and otherwise a
    `GatewayError`."""

    _places: Mapping[str, tuple[Line, Device]]
    _tags: Mapping[str, Tag]
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
        targets = () if place is None else place[1].settings.targets
        for tag, _ in values:  # its scale or limits may be others now
            if self._tags.get(tag.key) is not tag and tag not in targets:
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

    async def peek(self, device: str, text: str) -> Peeked:
        """Reads any addresses once, such as `D100..D119`."""
        if device not in self._places:
            raise Offline(f"no device {device} is polled here; nothing was sent")
        line, receiver = self._places[device]
        try:
            area, numbers = addresses(receiver.driver, text, MOST_PEEKED)
            parts = list(spans(receiver.driver, area, numbers))
        except ConfigError as error:
            raise BadValue(str(error)) from None
        loop = asyncio.get_running_loop()
        started, units = loop.time(), list[int]()
        within = WRITE_EXPIRY + line.dialling
        for part in parts:
            if self._places.get(device) != (line, receiver):
                raise Busy(f"the file was reloaded, and {device} with it; read it again")
            units += map(int, (await line.peek(receiver, part, within)).split())
        first = receiver.driver.spell(Address(area, numbers.start))
        return Peeked(first, units, self._wall(), loop.time() - started)

    def dialling(self, device: str) -> float:
        """Returns the seconds that a request may wait for a telephone call; 0: for none."""
        place = self._places.get(device)
        return 0.0 if place is None else place[0].dialling

    def _place(self, device: str) -> tuple[Line, Device]:
        if device not in self._places:
            raise Offline(f"device {device} is disabled; nothing was sent")
        return self._places[device]
