"""The history: samples on disk, as long as the configuration says, found by tag and time."""

from gateway.contract.timerange import TimeRange, time_range
from gateway.parts.history.historian import Historian

__all__ = ["Historian", "TimeRange", "time_range"]
