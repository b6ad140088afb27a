"""The command line as a Zenoh client of a running gateway."""

from gateway.client.client import Client, Shown
from gateway.client.connection import connected
from gateway.client.typed import matches, parse_value, wanted_keys

__all__ = ["Client", "Shown", "connected", "matches", "parse_value", "wanted_keys"]
