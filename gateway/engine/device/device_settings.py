"""One station on a line, as the file describes it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from gateway.protocols.driver import AnyDriver, Timing
from gateway.stations.served.registers import Served
from gateway.tags import Tag


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceSettings:
    """Times in seconds."""

    name: str
    driver: AnyDriver
    timing: Timing  # the defaults of the protocol, with the settings of the file
    turnaround: float | None = None  # None: measured
    late_guard: float = 0.5  # the longest wait for a late reply after a time-out
    identity: Mapping[str, str] = field(default_factory=dict)  # by name: of the driver, or a tag
    verify_reads: int = 1  # reads in a row that must agree
    blocks: bool | Literal["only"] = False  # one put per scan: also, or instead of one per tag
    control: bool = False  # run, stop, ... are allowed
    listen_only: bool = False  # another master asks it; nothing is ever sent
    templates: tuple[str, ...] = ()  # that it uses: for clients
    enabled: bool = True
    tags: tuple[Tag, ...] = ()
    targets: tuple[Tag, ...] = ()  # that only transfers write: no poll, no value
    served: Served | None = None  # it is a station of the gateway, for a master on its line
    wire_tags: tuple[Tag, ...] = field(init=False, repr=False)  # those with an address

    def __post_init__(self) -> None:
        tags = [tag for tag in self.tags if tag.origin.formula is None]
        found = tuple(tag if tag.origin.kept is None else tag.origin.inputs[0] for tag in tags)
        object.__setattr__(self, "wire_tags", found)

    @property
    def identity_tags(self) -> list[Tag]:
        """The tags whose values show which device it is."""
        return [tag for tag in self.wire_tags if tag.name in self.identity]

    @property
    def answerable(self) -> bool:
        """False for a device that is only written to, or only sends unsolicited frames."""
        areas = self.driver.areas
        used = [areas[tag.span.area] for tag in self.wire_tags] or areas.values()
        return any(area.readable for area in used) and not self.listen_only
