"""The messages of one way that wait to be sent, and how the last tries went. Bounded."""

from collections import deque
from collections.abc import Sequence
from typing import Any

from gateway.contract.documents.state import NotifyDocument
from gateway.parts.notify.message import Message
from gateway.tags.timestamps import rfc3339

MOST = 1000  # messages of one way; then the oldest is dropped


class Outbox:
    """Belongs to the event loop."""

    def __init__(self, keep: float) -> None:
        """`keep`: seconds until a message is dropped."""
        self._keep = round(keep * 1e9)
        self._waiting: deque[Message] = deque()
        self._sent = self._dropped = self.failed = 0
        self._trouble = ""
        self._sent_at: int | None = None  # ns since 1970

    def put(self, message: Message) -> None:
        if len(self._waiting) >= MOST:
            self._waiting.popleft()
            self._dropped += 1
        self._waiting.append(message)

    def first(self, now: int) -> Message | None:
        """Returns the message to send next. Drops those that are too old at `now`."""
        while self._waiting and now - self._waiting[0].time > self._keep:
            self._waiting.popleft()
            self._dropped += 1
        return self._waiting[0] if self._waiting else None

    def sent(self, message: Message, now: int) -> None:
        """Takes it out, unless it was dropped meanwhile."""
        if message in self._waiting:
            self._waiting.remove(message)
        self._sent, self._sent_at = self._sent + 1, now
        self.failed, self._trouble = 0, ""

    def not_sent(self, why: str) -> bool:
        """True if the cause is new."""
        self.failed += 1
        is_new, self._trouble = why != self._trouble, why
        return is_new

    def saved(self) -> list[dict[str, Any]]:
        return [one.saved() for one in self._waiting]

    def restore(self, known: Sequence[Message]) -> None:
        """Puts the messages from before a restart in front."""
        self._waiting.extendleft(reversed(known[-MOST:]))

    def document(self) -> NotifyDocument:
        oldest = rfc3339(self._waiting[0].time) if self._waiting else None
        return {
            "waiting": len(self._waiting),
            "oldest": oldest,
            "sent": self._sent,
            "last_sent": None if self._sent_at is None else rfc3339(self._sent_at),
            "failed": self.failed,
            "dropped": self._dropped,
            "trouble": self._trouble,
        }
