"""The keys that one gateway serves, what a client may do there, and its devices."""

import json
from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any

from gateway import __version__
from gateway.contract.documents.catalogue import PAST, described
from gateway.contract.documents.state import IntrospectDocument
from gateway.contract.interfaces import Device
from gateway.contract.keys import CONTRACT, Keys


@cache
def _documents() -> dict[str, Any]:
    found: dict[str, Any] = json.loads(described())["documents"]
    return found


def _of(keys: Keys, key: str) -> str:
    return key.replace("{prefix}", keys.prefix).replace("{gateway}", keys.gateway)


def introspection(
    keys: Keys,
    devices: Iterable[Device],
    commands: Mapping[str, frozenset[str]],
    *,
    signed: bool,
    history: bool,
) -> IntrospectDocument:
    """`commands`: of the protocol of each device, permitted or not."""
    return {
        "contract": CONTRACT,
        "gateway": keys.gateway,
        "version": __version__,
        "signed": signed,
        "history": history,
        "documents": {
            name: {
                "key": _of(keys, kind["key"]),
                "verbs": [verb for verb in kind["verbs"] if history or verb != PAST],
            }
            for name, kind in _documents().items()
            if history or kind["verbs"] != [PAST]
        },
        "devices": {
            device.name: {
                "tags": len(tags := list(device.tags)),
                "writable": sum(tag.write is not None for tag in tags),
                "commands": sorted(commands.get(device.name, ())) if device.control else [],
                "blocks": bool(device.blocks),
                "templates": list(device.templates),
            }
            for device in devices
        },
    }
