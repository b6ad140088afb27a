"""The command line as a Zenoh client of a running gateway."""

from gateway.client.client import NOTHING, Client, Shown, connected
from gateway.client.typed import matches, parse_value, wanted_keys

__all__ = ["NOTHING", "Client", "Shown", "connected", "matches", "parse_value", "wanted_keys"]
