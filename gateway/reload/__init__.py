"""Reload: takes over a changed file while the gateway runs, device by device."""

from gateway.reload.lines import RunningLines
from gateway.reload.live import LiveReload
from gateway.reload.reloader import Reloader

__all__ = ["LiveReload", "Reloader", "RunningLines"]
