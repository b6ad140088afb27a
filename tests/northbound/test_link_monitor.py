"""Links are logged with their address; a client that comes and goes is no event."""

from typing import Any, NamedTuple

import structlog
import zenoh

from gateway.northbound.session.link_monitor import LinkMonitor


class Transport(NamedTuple):
    zid: str
    whatami: str


class TransportEvent(NamedTuple):
    kind: object
    transport: Transport


UP, DOWN = zenoh.SampleKind.PUT, zenoh.SampleKind.DELETE


def logged(monitor: LinkMonitor, kind: object, session: str, whatami: str) -> list[Any]:
    event: Any = TransportEvent(kind, Transport(session, whatami))
    with structlog.testing.capture_logs() as entries:
        monitor.take(event, 0.0)
    return list(entries)


def happens(monitor: LinkMonitor, kind: object, session: str, whatami: str) -> list[Any]:
    entries = logged(monitor, kind, session, whatami)
    return [(entry["log_level"], entry["event"], entry["left"]) for entry in entries]


def test_the_last_link_that_goes_is_a_warning() -> None:
    monitor = LinkMonitor()
    happens(monitor, UP, "a", "router")
    happens(monitor, UP, "b", "peer")
    assert happens(monitor, DOWN, "a", "router") == [("info", "Zenoh link down", 1)]
    assert happens(monitor, DOWN, "b", "peer") == [("warning", "Zenoh link down", 0)]
    assert happens(monitor, DOWN, "b", "peer") == []  # it has gone already


def test_a_health_check_is_no_event_and_a_client_that_stayed_is_one() -> None:
    clock = [0.0]
    monitor = LinkMonitor(clock=lambda: clock[0])
    happens(monitor, UP, "check", "client")
    clock[0] = 0.5
    assert happens(monitor, DOWN, "check", "client") == [("debug", "Zenoh link down", 0)]
    happens(monitor, UP, "scada", "client")
    clock[0] = 3600.0
    assert happens(monitor, DOWN, "scada", "client") == [("warning", "Zenoh link down", 0)]


def warned(links: list[tuple[str, str]], *, is_peer: bool = True) -> int:
    """Returns how often a session with these links warns of several routers."""
    monitor = LinkMonitor(is_peer=is_peer)
    entries = [entry for link in links for entry in logged(monitor, UP, *link)]
    return sum(entry["event"] == "several routers" for entry in entries)


A, B, C = ("a", "router"), ("b", "router"), ("c", "router")


def test_a_peer_of_one_router_is_not_warned_of() -> None:
    assert warned([A]) == warned([A, ("p", "peer")]) == 0


def test_a_peer_whose_router_is_replaced_is_not_warned_of() -> None:
    monitor = LinkMonitor(is_peer=True)
    logged(monitor, UP, *A)
    logged(monitor, DOWN, *A)
    assert "several routers" not in [entry["event"] for entry in logged(monitor, UP, *B)]


def test_a_peer_of_several_routers_is_warned_of_once() -> None:
    assert warned([A, B, C]) == 1


def test_a_router_of_several_routers_is_not_warned_of() -> None:
    assert warned([A, B], is_peer=False) == 0
