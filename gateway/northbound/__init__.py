"""The Zenoh side of the gateway: one session, one publishing thread, bounded queues.

`Northbound` is made with `ZenohConfig` and the `Plant` it publishes, and `run`s until it is
cancelled. It never blocks the event loop, and no package below it imports Zenoh.
"""

from gateway.northbound.interfaces import Device, History, Plant
from gateway.northbound.northbound import Northbound, check, group_settings
from gateway.northbound.standby import GroupSettings

__all__ = [
    "Device",
    "History",
    "Northbound",
    "Plant",
    "GroupSettings",
    "check",
    "group_settings",
]
