"""Reload: takes over a changed file while the gateway runs, device by device."""

from gateway.service.reload.lines import RunningLines
from gateway.service.reload.live import LiveReload
from gateway.service.reload.reloader import Reloader
