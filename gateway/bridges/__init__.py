"""Bridges: programs of their own between the gateways below a prefix and other systems."""
