"""The orders of a writer: another file, its confirmation, and the way back."""

from collections.abc import Mapping
from enum import StrEnum
from typing import Any, NamedTuple

import orjson

from gateway.errors import BadValue
from gateway.parts.remote.settings import LONGEST_WAIT

SHORTEST_WAIT = 10.0  # seconds
_FIELDS = {"do", "file", "patch", "confirm", "digest"}


class Do(StrEnum):
    """The words of `do`."""

    CHECK = "check"
    APPLY = "apply"
    CONFIRM = "confirm"
    REVERT = "revert"
    ROLLBACK = "rollback"


class Order(NamedTuple):
    """One order. `file`: the whole text; `patch`: in place of it, settings that change;
    `confirm`: seconds until it goes back; `digest`: of the file that is confirmed, of an earlier
    one, or of the new one, if the writer knows it."""

    do: Do
    file: str = ""
    patch: Mapping[str, Any] | None = None
    confirm: float | None = None
    digest: str = ""


def parse_order(data: bytes) -> Order:
    """Raises `BadValue`."""
    try:
        found = orjson.loads(data)
    except orjson.JSONDecodeError:
        raise BadValue('the payload is no JSON: send {"do": "apply", "file": "..."}') from None
    if not isinstance(found, dict) or not found.keys() <= _FIELDS:
        raise BadValue(f"the payload is no order: its fields are {', '.join(sorted(_FIELDS))}")
    do = found.get("do")
    if not isinstance(do, str) or do not in [*Do]:
        raise BadValue(f"do is none of {', '.join(Do)}")
    needed = {Do.CHECK: "file", Do.APPLY: "file", Do.CONFIRM: "digest", Do.ROLLBACK: "digest"}
    patch = found.get("patch")
    if patch is not None and (
        not isinstance(patch, dict) or "file" in found or needed.pop(Do(do), "") != "file"
    ):
        raise BadValue("`patch` is settings by section, in place of `file`")
    for name in ("file", "digest"):
        text = found.get(name, "")
        if not isinstance(text, str) or (needed.get(Do(do)) == name and not text):
            raise BadValue(f"{do} needs a text in `{name}`")
    wait = found.get("confirm")
    if wait is not None and (
        isinstance(wait, bool)
        or not isinstance(wait, (int, float))
        or not SHORTEST_WAIT <= wait <= LONGEST_WAIT
    ):
        raise BadValue(f"confirm is no number from {SHORTEST_WAIT:.0f} to {LONGEST_WAIT:.0f}")
    return Order(Do(do), found.get("file", ""), patch, wait, found.get("digest", ""))
