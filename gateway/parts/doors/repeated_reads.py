"""The addresses that programs read again and again: proposals for tags."""

from dataclasses import dataclass

from gateway.config.transfers.ranges import UNIT_KINDS
from gateway.engine.device.device_settings import DeviceSettings
from gateway.parts.doors.documents import RepeatedRead
from gateway.protocols.driver import Address, Span

MOST_KEPT = 200  # spans of a door: those that were read last
MOST_SHOWN = 20
_REPEATED = 3  # reads


@dataclass(slots=True)
class _Reads:
    count: int
    first: float
    last: float


class RepeatedReads:
    """The reads of all programs of one door."""

    def __init__(self) -> None:
        self._known: dict[tuple[str, Span], _Reads] = {}

    def note(self, device: str, span: Span, now: float) -> None:
        """Notes one read."""
        reads = self._known.pop((device, span), None) or _Reads(0, now, now)
        reads.count, reads.last = reads.count + 1, now
        self._known[device, span] = reads
        if len(self._known) > MOST_KEPT:
            del self._known[next(iter(self._known))]

    def documents(self, devices: dict[str, DeviceSettings]) -> list[RepeatedRead]:
        """Returns those that are read most often, the most frequent first."""
        often = [one for one in self._known.items() if one[1].count >= _REPEATED]
        often.sort(key=lambda one: -one[1].count)
        return [
            _document(devices[name], span, reads)
            for (name, span), reads in often
            if name in devices
        ][:MOST_SHOWN]


def _document(device: DeviceSettings, span: Span, reads: _Reads) -> RepeatedRead:
    driver = device.driver
    kind = UNIT_KINDS[driver.areas[span.area].unit]
    return {
        "device": device.name,
        "address": driver.spell(Address(span.area, span.start)),
        "type": str(kind) if span.size == 1 else f"{kind}[{span.size}]",
        "count": reads.count,
        "every": round((reads.last - reads.first) / (reads.count - 1), 3),
        "tags": [tag.name for tag in device.wire_tags if tag.span.overlaps(span)][:MOST_SHOWN],
    }
