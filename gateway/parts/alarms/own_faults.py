"""The alarms of the gateway itself: a part that stopped, a full disk, a lost router."""

from collections.abc import Mapping
from functools import partial
from typing import Any

from gateway.contract.faults import coded_faults, coded_warnings
from gateway.plant.doors import Condition, Reading
from gateway.tags import AlarmRule, Level, Priority

GATEWAY = "gateway:"  # begins their keys; no device has a colon in its name
DELAY = 10.0  # seconds: a router that starts again, or a part, works again earlier
# The text and the priority of each fault and warning that is an alarm, by its code. Devices, lines
# and transfers have alarms of their own.
FAULTS = {
    "part-stopped": ("a part of the gateway stopped", Priority.HIGH),
    "no-router": ("the gateway is not connected to Zenoh's router", Priority.HIGH),
    "served-elsewhere": ("another gateway serves a device of this file", Priority.HIGH),
    "wrong-device": ("another device replies than the file names", Priority.HIGH),
    "history": ("samples are not written", Priority.HIGH),
    "not-saved": ("changes are not on disk", Priority.HIGH),
    "notify": ("messages about alarms wait", Priority.HIGH),
    "damaged-file": ("a damaged file was moved aside", Priority.MEDIUM),
    "certificate": ("a certificate has ended, or ends soon", Priority.MEDIUM),
    "disk-fills": ("the disk of the history is full soon", Priority.MEDIUM),
    "door-closed": ("a door is closed", Priority.MEDIUM),
    "answered-elsewhere": ("another program answers queries of this gateway", Priority.MEDIUM),
    "no-standby": ("no other gateway of the standby group waits", Priority.MEDIUM),
    "file-not-back": ("the remote file did not go back", Priority.MEDIUM),
}


class OwnFaults:
    """The faults of the gateway, as of the last status documents. One alarm for each code."""

    def __init__(self) -> None:
        self._found: Mapping[str, list[str]] | None = None  # sentences by code; None: not known

    def take(self, documents: Mapping[str, Mapping[str, Any]]) -> None:
        found: dict[str, list[str]] = {}
        for one in (*coded_faults(documents), *coded_warnings(documents)):
            if one.code in FAULTS:
                found.setdefault(one.code, []).append(one.text)
        self._found = found

    def conditions(self) -> dict[str, Condition]:
        """Returns the conditions by the key of their alarm."""
        return {
            f"{GATEWAY}{code}": Condition(
                AlarmRule({Level.FAULT: True}, delay=DELAY, priority=priority, text=text),
                partial(self._look, code),
            )
            for code, (text, priority) in FAULTS.items()
        }

    def _look(self, code: str) -> Reading:
        if self._found is None:
            return Reading(None)
        texts = self._found.get(code, ())
        return Reading(bool(texts), "; ".join(texts))
