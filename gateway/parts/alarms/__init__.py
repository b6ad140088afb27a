"""Alarms: the states of ISA-18.2 for tags, devices and lines, kept across restarts."""

from gateway.parts.alarms.board import Alarms, Entry
from gateway.parts.alarms.machine import Acknowledgement, Event, State, Status

__all__ = [
    "Acknowledgement",
    "Alarms",
    "Entry",
    "Event",
    "State",
    "Status",
]
