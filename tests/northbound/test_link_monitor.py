"""The links of a session: what is warned of."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import pytest
import structlog
import zenoh

from gateway.northbound.link_monitor import LinkMonitor


@dataclass(frozen=True)
class Transport:
    zid: str
    whatami: str


@dataclass(frozen=True)
class Event:
    """As Zenoh reports a link."""

    kind: zenoh.SampleKind
    transport: Transport


def warnings(events: Sequence[tuple[str, str, bool]], *, is_peer: bool = True) -> int:
    """Returns how often a session with these links warned: id, kind, and whether it came."""
    links = LinkMonitor(is_peer=is_peer)
    with structlog.testing.capture_logs() as entries:
        for zid, kind, came in events:
            sign = zenoh.SampleKind.PUT if came else zenoh.SampleKind.DELETE
            links.take(cast(zenoh.TransportEvent, Event(sign, Transport(zid, kind))), 0.0)
    return sum(entry["event"] == "several routers" for entry in entries)


A, B, C = (("a", "router", True), ("b", "router", True), ("c", "router", True))


@pytest.mark.parametrize("links", [[A], [A, ("p", "peer", True)], [A, ("a", "router", False), B]])
def test_a_peer_of_one_router_is_not_warned_of(links: list[tuple[str, str, bool]]) -> None:
    assert warnings(links) == 0


def test_a_peer_of_several_routers_is_warned_of_once() -> None:
    assert warnings([A, B, C]) == 1


def test_a_router_of_several_routers_is_not_warned_of() -> None:
    assert warnings([A, B], is_peer=False) == 0
