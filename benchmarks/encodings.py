"""How large documents are as JSON and as CBOR: `python -m benchmarks.encodings`.

CBOR as RFC 8949 describes it, with the shortest form of each number. `time as a number`: the same
fields, the time in microseconds. `numbers as names`: also no names, as a format of its own has.
docs/slow-links.md has the figures.
"""

import json
import random
import struct
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

NAMES = ("value", "quality", "time", "reason", "origin", "limited")


def head(kind: int, number: int) -> bytes:
    if number < 24:
        return bytes([kind << 5 | number])
    size = next(size for size in range(4) if number < 1 << (8 << size))
    return bytes([kind << 5 | 24 + size]) + number.to_bytes(1 << size, "big")


def cbor(item: Any) -> bytes:
    match item:
        case None | bool():
            return {False: b"\xf4", True: b"\xf5", None: b"\xf6"}[item]
        case int():
            return head(0, item) if item >= 0 else head(1, -1 - item)
        case float():
            for start, form in (b"\xf9", ">e"), (b"\xfa", ">f"):
                if (
                    abs(item) < 6e4
                    and struct.unpack(form, packed := struct.pack(form, item))[0] == item
                ):
                    return start + packed
            return b"\xfb" + struct.pack(">d", item)
        case str():
            return head(3, len(item.encode())) + item.encode()
        case Mapping():
            return head(5, len(item)) + b"".join(cbor(k) + cbor(v) for k, v in item.items())
        case Sequence():
            return head(4, len(item)) + b"".join(map(cbor, item))
    raise TypeError(item)


def with_numbers(item: Any, *, names: bool) -> Any:
    """The time as a number; and with `names` the names of fields too."""
    if not isinstance(item, dict):
        return item
    found = {name: with_numbers(one, names=names) for name, one in item.items()}
    if "time" in found:
        found["time"] = int(datetime.fromisoformat(found["time"]).timestamp() * 1e6)
    if not names or "value" not in found:
        return found
    good = {"quality": 0} if found["quality"] == "good" else {}
    return {NAMES.index(name): one for name, one in (found | good).items()}


def documents() -> dict[str, Any]:
    chance = random.Random(1)
    time = datetime(2026, 11, 20, 12, 0, 0, 145617, UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")

    def of(value: object) -> dict[str, Any]:
        return {"value": value, "quality": "good", "time": time}

    return {
        "a value": of(12.5),
        "a bad value": of(None) | {"quality": "bad", "reason": "no-reply"},
        "a block of 100 tags": {f"t{n:02}": of(chance.randrange(2000) / 10) for n in range(100)},
        "an array of 50 numbers": of([chance.randrange(2**16) for _ in range(50)]),
    }


def main() -> None:
    print("| document | JSON | CBOR | CBOR, time as a number | CBOR, numbers as names |")
    print("|---|---|---|---|---|")
    for name, document in documents().items():
        text = len(json.dumps(document, separators=(",", ":")))
        others = [document, *(with_numbers(document, names=names) for names in (False, True))]
        shares = [len(cbor(one)) for one in others]
        print(f"| {name} | {text} |", *(f"{size} ({size / text:.0%}) |" for size in shares))


if __name__ == "__main__":
    main()
