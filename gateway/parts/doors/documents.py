"""The document of a door: docs/share.md."""

from typing import Literal

from typing_extensions import TypedDict


class GuestDocument(TypedDict):
    """A program that is connected to a door; `since`: seconds ago."""

    address: str
    since: float
    requests: int
    writes: int
    refused: int
    unanswered: int


class RepeatedRead(TypedDict):
    """Addresses that programs at a door read again and again.

    `type`: of all of them, as a tag has it; `every`: seconds between two reads; `tags`: those of
    the device that have some of these addresses.
    """

    device: str
    address: str
    type: str
    count: int
    every: float
    tags: list[str]


class DoorDocument(TypedDict):
    """A door of a line for other programs.

    `share`: of the wire time of the last minute, by all doors of the line.
    """

    line: str
    listen: str
    protocol: str
    trouble: str
    most: float
    share: float
    turned_away: int
    programs: list[GuestDocument]
    reads: list[RepeatedRead]


class DoorRequest(TypedDict):
    """The order to disconnect the programs of a door."""

    do: Literal["release"]
