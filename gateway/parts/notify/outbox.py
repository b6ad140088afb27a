"""The messages of one way that wait to be sent, and how the last tries went. Bounded."""

from collections import deque
from collections.abc import Sequence
from typing import Any

from typing_extensions import TypedDict

from gateway.parts.notify.message import Message
from gateway.tags.timestamps import rfc3339

MOST = 1000  # messages of one way; then the oldest is dropped


class NotifyDocument(TypedDict):
    """One way on which alarms reach people.

    `oldest`: the time of the message that waits longest. `failed`: tries in a row. `dropped`:
    messages that were too old, or too many.
    """

    waiting: int
    oldest: str | None
    sent: int
    last_sent: str | None
    failed: int
    dropped: int
    trouble: str


class Outbox:
    """Belongs to the event loop, whose clock gives every `now`: a wall clock that jumps drops no
    message."""

    def __init__(self, keep: float) -> None:
        """`keep`: seconds until a message is dropped."""
        self._keep = keep
        self._waiting: deque[tuple[Message, float]] = deque()  # and since when it waits
        self._sent = self._dropped = self.failed = 0
        self._trouble = ""
        self._sent_at: int | None = None  # ns since 1970

    def put(self, message: Message, now: float) -> None:
        if len(self._waiting) >= MOST:
            self._waiting.popleft()
            self._dropped += 1
        self._waiting.append((message, now))

    def first(self, now: float) -> Message | None:
        """Returns the message to send next. Drops those that are too old at `now`."""
        while self._waiting and now - self._waiting[0][1] > self._keep:
            self._waiting.popleft()
            self._dropped += 1
        return self._waiting[0][0] if self._waiting else None

    def sent(self, message: Message, time: int) -> None:
        """Takes it out, unless it was dropped meanwhile. `time`: ns since 1970."""
        if self._waiting and self._waiting[0][0] is message:
            self._waiting.popleft()
        self._sent, self._sent_at = self._sent + 1, time
        self.failed, self._trouble = 0, ""

    def not_sent(self, why: str) -> bool:
        """True if the cause is new."""
        self.failed += 1
        is_new, self._trouble = why != self._trouble, why
        return is_new

    def saved(self, now: float) -> list[dict[str, Any]]:
        return [{**one.saved(), "waited": now - since} for one, since in self._waiting]

    def restore(self, known: Sequence[tuple[Message, float]], now: float) -> None:
        """Puts the messages from before a restart in front, with the seconds that each waited."""
        self._waiting.extendleft((one, now - waited) for one, waited in reversed(known[-MOST:]))

    def document(self) -> NotifyDocument:
        oldest = rfc3339(self._waiting[0][0].time) if self._waiting else None
        return {
            "waiting": len(self._waiting),
            "oldest": oldest,
            "sent": self._sent,
            "last_sent": None if self._sent_at is None else rfc3339(self._sent_at),
            "failed": self.failed,
            "dropped": self._dropped,
            "trouble": self._trouble,
        }
