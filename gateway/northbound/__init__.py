"""The Zenoh side of the gateway: one session, one publishing thread, bounded queues.

`Northbound` is made with `ZenohConfig` and the `Plant` it speaks for, and `run`s until it is
cancelled. Nothing it does holds the event loop, and nothing below it knows Zenoh.
"""

from gateway.northbound.check import check
from gateway.northbound.duty import StandbySettings
from gateway.northbound.northbound import Northbound
from gateway.northbound.plant import Device, History, Plant

__all__ = [
    "Device",
    "History",
    "Northbound",
    "Plant",
    "StandbySettings",
    "check",
]
