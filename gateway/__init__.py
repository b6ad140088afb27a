"""A gateway between PLCs on serial lines and Eclipse Zenoh."""

__version__ = "1.0.0"
