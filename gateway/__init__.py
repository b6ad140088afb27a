"""A gateway between PLCs on serial lines and Eclipse Zenoh."""

__version__ = "0.1.0"
