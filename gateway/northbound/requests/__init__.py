"""Writes and commands from Zenoh: accepted, passed on, audited."""
