"""Reload: takes over a changed file while the gateway runs, device by device."""

from gateway.service.reload.live import LiveReload
from gateway.service.reload.reloader import Reloader
from gateway.service.reload.renewal import RunningLines
