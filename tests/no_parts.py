"""A gateway without parts, for the Zenoh side alone."""

from gateway.contract.interfaces import History, Keyed
from gateway.errors import Busy


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
