"""A gateway without parts, for the Zenoh side alone."""

from gateway.contract.interfaces import History, Keyed
from gateway.errors import Busy

# The document `status` of a gateway without lines.
STATUS: dict[str, object] = {
    "contract": 2,
    "name": "demo",
    "version": "1.0.0",
    "time": "2026-11-24T12:00:00.000000Z",
    "up": 1.0,
    "tags": 3,
    "simulated": [],
    "replayed": [],
    "lines": {},
    "devices": {},
}


class NoParts:
    """A gateway without parts."""

    def has_keys(self, part: str) -> bool:
        return False

    def keyed(self, part: str) -> Keyed:
        raise Busy(f"there is no {part} here")

    def history(self) -> History | None:
        return None

    def audit(self, at: int, event: str) -> None:
        """Keeps nothing."""

    async def publish_all(self) -> None:
        """Publishes nothing."""
