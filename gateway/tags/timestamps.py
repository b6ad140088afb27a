"""Times as text: nanoseconds since 1970 in the form that every document and payload uses."""

from datetime import UTC, datetime
from functools import lru_cache


@lru_cache(maxsize=256)  # the samples of one scan share one time
def rfc3339(time: int) -> str:
    """Nanoseconds since 1970 as `2026-11-20T12:00:00.123456Z`."""
    return f"{_second(time // 1_000_000_000)}.{time // 1000 % 1_000_000:06}Z"


@lru_cache(maxsize=256)
def _second(seconds: int) -> str:
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%S")
