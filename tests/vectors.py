"""The checked frames of vectors.json: worked examples of the manuals and what follows from them."""

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Vector:
    id: str
    protocol: str
    direction: str
    description: str
    fields: dict[str, Any]
    frame: bytes
    valid: bool

    def __repr__(self) -> str:
        return self.id


@cache
def _all() -> tuple[Vector, ...]:
    rows = json.loads((Path(__file__).parent / "vectors.json").read_text())
    return tuple(
        Vector(
            id=row["id"],
            protocol=row["protocol"],
            direction=row["direction"],
            description=row["description"],
            fields=row["fields"],
            frame=bytes.fromhex(row["frame_hex"]),
            valid=row["valid"],
        )
        for row in rows
    )


def vectors(*protocols: str) -> list[Vector]:
    """The vectors of these protocols, in the order of the file; never empty."""
    found = [vector for vector in _all() if vector.protocol in protocols]
    assert found, protocols
    return found
