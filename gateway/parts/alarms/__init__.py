"""Alarms: the states of ISA-18.2 for tags, devices and lines, kept across restarts."""

from gateway.parts.alarms.board import Alarms, Entry, Reading
from gateway.parts.alarms.machine import Acknowledgement, Event, NothingToAcknowledge, State, Status

__all__ = [
    "Acknowledgement",
    "Alarms",
    "Entry",
    "Event",
    "NothingToAcknowledge",
    "Reading",
    "State",
    "Status",
]
