"""Reads and writes of addresses that no tag names: peeks, and the doors of a line."""

import asyncio
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from gateway.config.messages import Mistakes, OptionPlaces
from gateway.config.tags.section import TagDefaults, TagSection, TagSource
from gateway.config.tags.word_tags import build_tag
from gateway.config.transfers.ranges import UNIT_KINDS
from gateway.engine.device.device import Device
from gateway.engine.jobs.requests import WRITE_EXPIRY, Peeked
from gateway.errors import BadValue, Busy, ConfigError, Offline
from gateway.line.line import Line
from gateway.protocols.driver import Address, AnyDriver, Span
from gateway.protocols.ranges import addresses, spans
from gateway.tags import Tag

MOST_PEEKED = 256  # addresses of one peek
LOST = 0.02  # share of polls: more are lost where the wire has no time for them
MOST_TARGETS = 1000  # that are remembered


@dataclass(eq=False)
class AnyAddress:
    """Each method raises `BadValue` before anything is sent, and otherwise a `GatewayError`."""

    _places: Mapping[str, tuple[Line, Device]]
    _wall: Callable[[], int]
    _targets: dict[Span, dict[str, tuple[AnyDriver, Tag]]] = field(default_factory=dict)

    async def peek(self, device: str, text: str) -> Peeked:
        """Reads addresses once, such as `D100..D119`."""
        line, receiver = self.place(device)
        try:
            area, numbers = addresses(receiver.driver, text, MOST_PEEKED)
        except ConfigError as error:
            raise BadValue(str(error)) from None
        loop = asyncio.get_running_loop()
        started = loop.time()
        span = Span(area, numbers.start, len(numbers))
        units = await self.read(device, span, WRITE_EXPIRY + line.dialling)
        first = receiver.driver.spell(Address(area, numbers.start))
        return Peeked(first, units, self._wall(), loop.time() - started)

    async def read(self, device: str, span: Span, within: float) -> list[int]:
        """Returns the units. After `within` seconds no request is sent any more."""
        line, receiver = self.place(device)
        units = list[int]()
        for part in _parts(receiver, span):
            if self._places.get(device) != (line, receiver):
                raise Busy(f"the file was reloaded, and {device} with it; read it again")
            units += map(int, (await line.peek(receiver, part, within)).split())
        return units

    def requested(self, device: str) -> float:
        """Returns the seconds that the line of the device has spent on requests so far."""
        return self._places[device][0].engine.record.requested if device in self._places else 0.0

    def resyncs(self, device: str) -> float:
        """Returns the seconds of the resyncs after requests that the line got no reply to."""
        here = device in self._places
        return self._places[device][0].engine.record.resyncs.seconds if here else 0.0

    def is_late(self, device: str) -> bool:
        """Returns True while the line of the device loses polls: its wire has no time for them."""
        engine = self.place(device)[0].engine
        due = done = 0.0  # polls a second
        for one in engine.devices:
            for poll in engine.polls(one) if one.health.online else ():
                if poll.reads.at is not None and poll.reads.mean_gap:
                    due += 1 / one.interval(poll.block)
                    done += 1 / poll.reads.mean_gap
        return done < (1 - LOST) * due

    def known(self, device: str, span: Span, max_age: float) -> list[int] | None:
        """Returns the units if a poll has read all of them together in the last `max_age` seconds,
        and no write or command on the line has ended since."""
        line, receiver = self.place(device)
        if not (line.engine.is_open and receiver.health.online):
            return None
        since = asyncio.get_running_loop().time() - max_age
        for poll in line.engine.polls(receiver):
            block, reads = poll.block, poll.reads
            ahead = span.start - block.span.start
            if block.listed or block.of_fields or span.area != block.span.area:
                continue
            if ahead < 0 or ahead + span.size > block.span.size:
                continue
            if reads.scan and reads.at and reads.at > max(since, line.engine.record.wrote_at):
                return [int(unit) for unit in reads.scan.units[ahead : ahead + span.size]]
        return None

    def target(self, device: str, span: Span) -> Tag:
        """Returns a tag of these addresses for one write. No client sees it."""
        _, receiver = self.place(device)
        driver, made = receiver.driver, self._targets.setdefault(span, {})
        not_real = next((tag.origin.not_real for tag in receiver.settings.wire_tags), None)
        known, tag = made.get(device, (None, None))
        if tag is None or known != driver or tag.origin.not_real != not_real:
            made[device] = driver, _tag(device, driver, span).with_origin(not_real)
            if len(self._targets) > MOST_TARGETS:
                self._targets.clear()
                self._targets[span] = {device: made[device]}
        return made[device][1]

    def is_target(self, tag: Tag, driver: AnyDriver) -> bool:
        """Returns True if `target` made the tag for this device."""
        return self._targets.get(tag.span, {}).get(tag.device) == (driver, tag)

    def place(self, device: str) -> tuple[Line, Device]:
        """Returns the device and its line. Raises `Offline`."""
        if device not in self._places:
            raise Offline(f"no device {device} is polled here; nothing was sent")
        return self._places[device]

    def refresh(self, device: str, written: Iterable[Span]) -> None:
        """Has the tags read again that a write changed."""
        if device not in self._places:
            return  # a reload removed it
        (line, receiver), spans_written = self._places[device], [*written]
        for tag in receiver.settings.wire_tags:
            if any(tag.span.overlaps(span) for span in spans_written):
                line.expedite(receiver, tag)


def _parts(device: Device, span: Span) -> list[Span]:
    """Returns the spans of the requests that read `span`."""
    try:
        return [*spans(device.driver, span.area, range(span.start, span.start + span.size))]
    except ConfigError as error:
        raise BadValue(str(error)) from None


def _tag(device: str, driver: AnyDriver, span: Span) -> Tag:
    """Raises `BadValue` where nothing can be written."""
    first, last = (Address(span.area, span.start + ahead) for ahead in (0, span.size - 1))
    kind = UNIT_KINDS[driver.areas[span.area].unit]
    spelt = driver.spell(first)
    name = spelt if span.size == 1 else f"{spelt}..{driver.spell(last)}"
    section = TagSection.model_validate(
        {
            "address": spelt,
            "type": str(kind) if span.size == 1 else f"{kind}[{span.size}]",
            "write": True,
        }
    )
    mistakes = Mistakes(OptionPlaces())
    source = TagSource(device, f"@{name.replace(':', '-')}", section, TagDefaults(), mistakes)
    tag = build_tag(source, driver)
    if tag is None or tag.write is None or len(mistakes):
        raise BadValue("; ".join(mistakes.sentences()) or f"{name} cannot be written")
    return tag
