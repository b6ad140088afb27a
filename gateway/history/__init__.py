"""The history: samples on disk, as long as the configuration says, found by tag and time."""

from gateway.history.historian import Historian
from gateway.history.timerange import TimeRange, time_range

__all__ = ["Historian", "TimeRange", "time_range"]
