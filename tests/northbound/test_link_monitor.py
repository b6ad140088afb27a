"""Links are logged with their address; a client that comes and goes is no event."""

from typing import Any, NamedTuple

import structlog
import zenoh

from gateway.northbound.link_monitor import LinkMonitor


class Transport(NamedTuple):
    zid: str
    whatami: str


class TransportEvent(NamedTuple):
    kind: object
    transport: Transport


UP, DOWN = zenoh.SampleKind.PUT, zenoh.SampleKind.DELETE


def happens(monitor: LinkMonitor, kind: object, session: str, whatami: str) -> list[Any]:
    event: Any = TransportEvent(kind, Transport(session, whatami))
    with structlog.testing.capture_logs() as logged:
        monitor.take(event, 0.0)
    return [(entry["log_level"], entry["event"], entry["left"]) for entry in logged]


def test_the_last_link_that_goes_is_a_warning() -> None:
    monitor = LinkMonitor()
    happens(monitor, UP, "a", "router")
    happens(monitor, UP, "b", "peer")
    assert happens(monitor, DOWN, "a", "router") == [("info", "Zenoh link down", 1)]
    assert happens(monitor, DOWN, "b", "peer") == [("warning", "Zenoh link down", 0)]
    assert happens(monitor, DOWN, "b", "peer") == []  # it has gone already


def test_a_health_check_is_no_event_and_a_client_that_stayed_is_one() -> None:
    clock = [0.0]
    monitor = LinkMonitor(lambda: clock[0])
    happens(monitor, UP, "check", "client")
    clock[0] = 0.5
    assert happens(monitor, DOWN, "check", "client") == [("debug", "Zenoh link down", 0)]
    happens(monitor, UP, "scada", "client")
    clock[0] = 3600.0
    assert happens(monitor, DOWN, "scada", "client") == [("warning", "Zenoh link down", 0)]
