"""Browsing of the address space, in parts: asyncua answers all at once, however much it is."""

import asyncio
import secrets
from collections.abc import Sequence
from functools import lru_cache

from asyncua import ua
from asyncua.server.address_space import AddressSpace, ViewService

Code = ua.StatusCodes
MOST_REFERENCES = 2_000  # of one node in one answer
MOST_IN_ANSWER = 5_000
MOST_POINTS = 20  # continuation points of one session
_NULL = ua.NodeId(ua.ObjectIds.Null)


class Views(ViewService):
    """Browses the nodes."""

    def __init__(self, aspace: AddressSpace) -> None:
        super().__init__(aspace)
        self._subtypes = lru_cache(256)(self._subtypes_of)  # types of references do not change

    async def browse_all(
        self,
        nodes: Sequence[ua.BrowseDescription],
        asked: int,
        rest: dict[bytes, list[ua.ReferenceDescription]],
    ) -> list[ua.BrowseResult]:
        """`asked`: the most references of one node, 0: all. `rest`: what did not fit, by
        continuation point."""
        results, left = [], MOST_IN_ANSWER
        for node in nodes:
            result = self._browse(node)
            most = min(asked or MOST_REFERENCES, MOST_REFERENCES, max(left, 1))
            _part(result, result.References, most, rest)
            left -= len(result.References)
            results.append(result)
            await asyncio.sleep(0)
        return results

    def go_on(
        self, point: bytes, release: bool, rest: dict[bytes, list[ua.ReferenceDescription]]
    ) -> ua.BrowseResult:
        result, found = ua.BrowseResult(), rest.pop(point, None)
        if found is None:
            result.StatusCode = ua.StatusCode(Code.BadContinuationPointInvalid)
        elif not release:
            _part(result, found, MOST_REFERENCES, rest)
        return result

    def _browse(self, desc: ua.BrowseDescription) -> ua.BrowseResult:
        if desc.NodeId not in self._aspace:
            return ua.BrowseResult(StatusCode=ua.StatusCode(Code.BadNodeIdUnknown))
        wanted = None
        if desc.ReferenceTypeId != _NULL:
            wanted = {desc.ReferenceTypeId}
            if desc.IncludeSubtypes:
                wanted |= self._subtypes(desc.ReferenceTypeId)
        found = [
            one
            for one in self._aspace[desc.NodeId].references
            if (wanted is None or one.ReferenceTypeId in wanted)
            and self._suitable_direction(desc.BrowseDirection, one.IsForward)
            and (not desc.NodeClassMask or desc.NodeClassMask & one.NodeClass)
        ]
        return ua.BrowseResult(References=found)

    def _suitable_reftype(self, ref1: ua.NodeId, ref2: ua.NodeId, subtypes: bool) -> bool:
        return ref1 in (_NULL, ref2) or (subtypes and ref2 in self._subtypes(ref1))

    def _subtypes_of(self, kind: ua.NodeId) -> frozenset[ua.NodeId]:
        return frozenset(self._get_sub_ref(kind))


def _part(
    result: ua.BrowseResult,
    found: list[ua.ReferenceDescription],
    most: int,
    rest: dict[bytes, list[ua.ReferenceDescription]],
) -> None:
    result.References = found[:most]
    if len(found) <= most:
        return
    while len(rest) >= MOST_POINTS:
        del rest[next(iter(rest))]  # of a client that left it
    result.ContinuationPoint = secrets.token_bytes(8)
    rest[result.ContinuationPoint] = found[most:]
