"""Makes the rows of `transfers:`: finds their tags, what does not fit, and loops."""

from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter

from gateway.config.messages import Mistakes, similar
from gateway.config.settings.records import LineConfig
from gateway.config.settings.validate import section
from gateway.config.tags.served import sort_of
from gateway.config.transfers.ranges import Ranges, is_range
from gateway.config.transfers.settings import TransferSection
from gateway.engine.device.device_settings import DeviceSettings
from gateway.errors import BadValue
from gateway.protocols.driver import AnyDriver
from gateway.protocols.unsolicited import Unsolicited
from gateway.tags import Tag
from gateway.tags.transfer import TransferRule, leaves

SHORTEST_STALE = 5.0  # seconds, where the file says nothing
INTERVALS = 3.0  # of the source, where that is longer
MOST_NAMED = 20_000  # tags that a misspelt name is compared with


@dataclass(slots=True)
class TransferRows:
    """Builds the rows of one file, and notes every mistake."""

    lines: Sequence[LineConfig]
    intervals: Mapping[str, float]  # by device: the default interval of its tags
    mistakes: Mistakes

    def build(self, raw: object) -> tuple[list[LineConfig], tuple[TransferRule, ...]]:
        """Returns the lines with the tags of ranges, and the rows without mistakes."""
        rows = raw if isinstance(raw, list) else []
        if not rows:
            return [*self.lines], ()
        ranges = Ranges(self.lines, self.intervals, self.mistakes)
        finder = _Finder.of(self.lines, ranges, certain=not len(self.mistakes))
        found = [rule for place, row in enumerate(rows) if (rule := self._row(place, row, finder))]
        self._check_repeats(found)
        self._check_loops([(rule, *finder.both(rule)) for rule in found])
        return ranges.added(), tuple(found)

    def _row(self, place: int, raw: object, finder: "_Finder") -> TransferRule | None:
        mistakes = self.mistakes.at("transfers", place)
        own = section(TransferSection, raw, mistakes, "a transfer")
        if own is None:
            return None
        before, wrong = len(mistakes), list[tuple[str, str]]()
        source, target = finder.ends(own, mistakes, wrong)
        if source is not None:
            wrong += finder.unreadable(source)
        if target is not None:
            wrong += finder.unwritable(target)
        if source is not None and target is not None:
            wrong += _misfits(own, source, target)
        for setting, problem in wrong:
            mistakes.add(problem, *setting.split("."))
        if len(mistakes) > before or source is None or target is None:
            return None
        return TransferRule(
            number=place + 1,
            source=source.key,
            target=target.key,
            text=(own.from_, own.to),
            every=own.every,
            scale=own.scale,
            offset=own.offset,
            stale=own.stale or max(SHORTEST_STALE, INTERVALS * source.every),
            substitute=own.if_stale,
            read_every=finder.read_every(source),
        )

    def _check_repeats(self, rules: Sequence[TransferRule]) -> None:
        """Notes rows that would write the same value a second time."""
        first: dict[tuple[str, str], int] = {}
        for rule in rules:
            other = first.setdefault((rule.source, rule.target), rule.number)
            if other != rule.number:
                text = f"row {other} carries {rule.text[0]} to {rule.text[1]} already"
                self.mistakes.add(f"{text}: remove one of the rows", "transfers", rule.number - 1)

    def _check_loops(self, rows: Sequence[tuple[TransferRule, Tag, Tag]]) -> None:
        """Notes loops: a row writes what another one, or the same one, reads."""
        readers = defaultdict[_Cell, list[tuple[int, int]]](list)
        for rule, source, _ in rows:
            for cell, bits in _cells(source):
                readers[cell].append((rule.number, bits))
        after = {
            rule.number: {
                number
                for cell, bits in _cells(target)
                for number, read in readers.get(cell, ())
                if read & bits
            }
            for rule, _, target in rows
        }
        names = {rule.number: " -> ".join(rule.text) for rule, _, _ in rows}
        while loop := _loop(after):
            way = ", ".join(f"row {number} ({names[number]})" for number in loop)
            text = f"a loop: {way}: a value would follow from itself; remove one of the rows"
            self.mistakes.add(text, "transfers", max(loop) - 1)
            del after[max(loop)]


@dataclass(frozen=True, slots=True)
class _Finder:
    tags: Mapping[str, Tag]
    devices: Mapping[str, DeviceSettings]
    ranges: Ranges
    certain: bool  # False: a tag may be missing because of another mistake

    @classmethod
    def of(cls, lines: Sequence[LineConfig], ranges: Ranges, *, certain: bool) -> "_Finder":
        devices = {device.name: device for line in lines for device in line.devices}
        tags = {tag.key: tag for one in devices.values() for tag in one.tags}
        return cls(tags, devices, ranges, certain)

    def ends(
        self, own: TransferSection, mistakes: Mistakes, wrong: list[tuple[str, str]]
    ) -> tuple[Tag | None, Tag | None]:
        """Returns source and target, or notes what would be right. Tags come before ranges."""
        source = None if is_range(own.from_) else self.find(own.from_, "from", wrong)
        target = None if is_range(own.to) else self.find(own.to, "to", wrong)
        if is_range(own.from_):
            found = self.ranges.source(own.from_, own.every, target, mistakes.at("from"))
            return found, target or self._target(own, found, mistakes)
        return source, target or self._target(own, source, mistakes)

    def _target(self, own: TransferSection, source: Tag | None, mistakes: Mistakes) -> Tag | None:
        return self.ranges.target(own.to, source, mistakes.at("to")) if is_range(own.to) else None

    def find(self, text: str, setting: str, wrong: list[tuple[str, str]]) -> Tag | None:
        """Returns the tag, or notes what would be right."""
        tag = self.tags.get(text)
        if tag is None and self.certain:
            wrong.append((setting, f"there is no tag {text}: {self._hint(text)}"))
        return tag

    def _hint(self, text: str) -> str:
        device = text.partition("/")[0]
        if device in self.devices:
            known = [tag.key for tag in self.devices[device].tags][:MOST_NAMED]
        else:
            known = [*self.tags][:MOST_NAMED]
        close = similar(text, known)
        return f"did you mean {close}?" if close else "write device/tag, a tag of this file"

    def both(self, rule: TransferRule) -> tuple[Tag, Tag]:
        source = self.tags.get(rule.source) or self.ranges.read[rule.source]
        return source, self.tags.get(rule.target) or self.ranges.written[rule.target]

    def unreadable(self, tag: Tag) -> Iterator[tuple[str, str]]:
        for one in leaves(tag):
            device = self.devices.get(one.device)
            if device is None or device.served is not None:
                continue
            driver = device.driver
            readable = driver.areas[one.span.area].readable and one.polled
            if not (_arrives(driver, one) or readable):
                yield "from", f"{one.key} can only be written, so there is no value to carry"

    def read_every(self, tag: Tag) -> float:
        """Returns the shortest interval of the polls that read it; 0: it arrives by itself."""
        polled = [one.every for one in leaves(tag) if self._is_polled(one)]
        return min(polled, default=0.0)

    def _is_polled(self, tag: Tag) -> bool:
        device = self.devices.get(tag.device)
        if device is None or device.served is not None or device.listen_only:
            return False
        return not _arrives(device.driver, tag)

    def unwritable(self, tag: Tag) -> Iterator[tuple[str, str]]:
        if tag.origin.formula is not None:
            yield "to", f"{tag.key} is computed from other tags: name a tag with an address"
        elif tag.write is None:
            yield "to", f"{tag.key} may only be read: write `write: true` at that tag"
        elif self.devices[tag.device].listen_only:
            yield "to", f"{tag.key} is on a line with `listen_only: true`: nothing is sent there"


def _misfits(own: TransferSection, source: Tag, target: Tag) -> Iterator[tuple[str, str]]:
    if (word := source.origin.not_real) is not None and target.origin.not_real is None:
        yield "from", f"{own.from_} is {word}: its values are never written to a real device"
    counts = source.layout.type.count, target.layout.type.count
    if counts[0] != counts[1]:
        sizes = f"{_size(own.from_, counts[0])}, and {_size(own.to, counts[1])}"
        yield "to", f"{sizes}: both ends of a row have the same length"
        return
    kinds = sort_of(source), sort_of(target)
    if kinds[0] != kinds[1]:
        types = f"{own.to} is {target.layout.type}, and {own.from_} is {source.layout.type}"
        yield "to", f"{types}: a {kinds[0]} is carried to a {kinds[0]} only"
        return
    for setting in ("scale", "offset"):
        if kinds[0] != "number" and setting in own.model_fields_set:
            yield setting, f"{own.from_} is a {kinds[0]}: only a number has a {setting}"
    if own.stale is not None and own.stale <= source.every:
        read = f"{own.from_} is read every {source.every:g} s: it would always be too old"
        longer = f"stale: {INTERVALS * source.every:g}s"
        yield "stale", f"{read}; write {longer}, or a shorter `every` at that tag"
    if own.if_stale is not None:
        try:
            target.encode(own.if_stale)
        except BadValue as error:
            yield "if_stale.write", f"{own.to} cannot take it: {error}"


def _size(text: str, count: int) -> str:
    return f"{text} has {count} elements" if count else f"{text} has one value"


def _arrives(driver: AnyDriver, tag: Tag) -> bool:
    """Returns True if the device sends the value by itself: no poll reads it."""
    return isinstance(driver, Unsolicited) and driver.unsolicited_only(tag.span)


_Cell = tuple[str, str, int]  # device, area, number


def _cells(tag: Tag) -> Iterator[tuple[_Cell, int]]:
    """Yields the places that a value comes from, or goes to, with the bits of each."""
    for one in leaves(tag):
        bits = 0xFFFF_FFFF if one.part is None else one.part.bits
        for number in range(one.span.start, one.span.start + one.span.size):
            yield (one.device, one.span.area, number), bits


def _loop(after: Mapping[int, Collection[int]]) -> list[int]:
    """Returns the rows of one loop, from the lowest number on; none without a loop."""
    try:
        TopologicalSorter(after).prepare()
    except CycleError as error:
        loop: list[int] = error.args[1][:0:-1]
        first = loop.index(min(loop))
        return loop[first:] + loop[:first]
    return []
