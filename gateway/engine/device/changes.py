"""Changed devices of one line, after the file was read again."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

from gateway.engine.device.device import Device
from gateway.tags import Tag

Known = TypeVar("Known")


@dataclass(frozen=True, slots=True)
class Changes:
    """The devices that an engine takes over together. Those that are new have a plan."""

    removed: Sequence[Device] = ()
    added: Sequence[Device] = ()
    replaced: Sequence[tuple[Device, Device]] = ()  # the same station with other settings
    renewed: Mapping[Tag, Tag] = field(default_factory=dict)  # old to new: the value goes on

    @property
    def left(self) -> list[Device]:
        """The devices that the engine forgets."""
        return [*self.removed, *(old for old, _ in self.replaced)]

    def carry(self, known: dict[Device, Known]) -> None:
        """Gives what is known of a device to the one in its place: it is the same station."""
        for old, new in self.replaced:
            if old in known:
                known[new] = known[old]
        for device in self.left:
            known.pop(device, None)

    def exchange(self, devices: set[Device]) -> None:
        """Puts the devices that replace those of the set in their places."""
        devices.update(new for old, new in self.replaced if old in devices)
        devices.difference_update(self.left)

    def applied(self, devices: Sequence[Device]) -> list[Device]:
        """Returns the devices of the line after the changes."""
        following = dict(self.replaced)
        stay = [following.get(one, one) for one in devices if one not in self.removed]
        return [*stay, *self.added]
