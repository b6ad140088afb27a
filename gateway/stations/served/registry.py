"""The answering machines, by the name of their protocol."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from gateway.stations.served import modbus_wire
from gateway.stations.served.answering import Answerer, Stations, Wire
from gateway.stations.served.computer_link import computer_link
from gateway.stations.served.vigor import vigor

MakeAnswerer = Callable[[Stations, Wire], Answerer]


class _Served(NamedTuple):
    """`make` returns the machine for the stations of a line; they share the `common` settings.

    Protocols of one family carry the same requests in other frames.
    """

    make: MakeAnswerer
    family: str
    common: Sequence[str] = ()
    numbered: bool = False  # a reply has the number of its request


_SERVED: dict[str, _Served] = {
    "modbus-tcp": _Served(modbus_wire.tcp, "modbus", numbered=True),
    "modbus-rtu": _Served(modbus_wire.rtu, "modbus"),
    "modbus-ascii": _Served(modbus_wire.ascii_line, "modbus"),
    "vigor": _Served(vigor, "vigor"),
    "computer-link": _Served(computer_link, "computer-link", ("frame_format", "sum_check")),
}


def can_serve(protocol: str) -> bool:
    return protocol in _SERVED


def served_protocols() -> list[str]:
    return list(_SERVED)


def is_numbered(protocol: str) -> bool:
    """Returns True if no reply is taken for that to another request."""
    return can_serve(protocol) and _SERVED[protocol].numbered


def relatives(protocol: str) -> list[str]:
    """Returns the protocols in whose frames a station of this protocol can be asked."""
    if not can_serve(protocol):
        return []
    return [name for name, one in _SERVED.items() if one.family == _SERVED[protocol].family]


def common_settings(protocol: str) -> Sequence[str]:
    """Returns the settings that are the same for all stations of a line."""
    return _SERVED[protocol].common if can_serve(protocol) else ()


def answerer(protocol: str, stations: Stations, wire: Wire) -> Answerer:
    """Returns a new machine."""
    return _SERVED[protocol].make(stations, wire)
