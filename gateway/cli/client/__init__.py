"""The command line as a Zenoh client of a running gateway."""

from gateway.cli.client.client import Client, Shown
from gateway.cli.client.connection import connected
from gateway.cli.client.typed import matches, parse_value, wanted_keys

__all__ = ["Client", "Shown", "connected", "matches", "parse_value", "wanted_keys"]
