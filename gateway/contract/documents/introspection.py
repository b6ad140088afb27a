"""The keys that one gateway serves, what a client may do there, and its devices."""

from collections.abc import Iterable, Mapping

from gateway import __version__
from gateway.contract.documents.catalogue import KINDS, PAST
from gateway.contract.documents.state import IntrospectDocument
from gateway.contract.interfaces import Device
from gateway.contract.keys import CONTRACT, Keys


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
            kind.name: {
                "key": f"{keys.prefix}/{kind.key}".replace("{gateway}", keys.gateway),
                "verbs": [verb for verb in kind.verbs if history or verb != PAST],
            }
            for kind in KINDS
            if history or kind.verbs != (PAST,)
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
