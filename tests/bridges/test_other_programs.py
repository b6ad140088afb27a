"""Answers of another program in place of a gateway: they end no bridge, and prove nothing."""

import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from datetime import UTC, datetime

import pytest
import zenoh
from asyncua import ua
from asyncua.server.internal_server import InternalServer

from gateway.bridges.documents import MOST_ELEMENTS, described_by
from gateway.bridges.opcua.history import History
from gateway.bridges.remote_plant import RemotePlant
from gateway.errors import GatewayError
from tests.bridges.played import META, answered

SPEED = ua.NodeId("mixer/speed", 2)


@asynccontextmanager
async def plant(answer: Callable[[zenoh.Query], None]) -> AsyncIterator[RemotePlant]:
    """A plant with the tag `mixer/speed`, where every query has this answer."""
    async with answered("plant/**", answer) as session:
        found = RemotePlant(session, "plant", lambda *_: None, lambda *_: None)
        found.tags["mixer/speed"] = META
        yield found


def refuses(payload: str) -> Callable[[zenoh.Query], None]:
    as_json = zenoh.Encoding.APPLICATION_JSON
    return lambda query: query.reply_err(payload, encoding=as_json)


@pytest.mark.parametrize(
    "answer",
    [
        lambda query: query.reply(query.key_expr, "]"),
        lambda query: query.reply(query.key_expr, "7"),
        refuses("]"),
        refuses("[]"),
        refuses("{}"),
    ],
)
async def test_an_answer_to_a_write_that_is_none_leaves_it_unclear(
    answer: Callable[[zenoh.Query], None],
) -> None:
    """The write may have been done: `bad-value` would say that it was not."""
    async with plant(answer) as remote:
        known = await remote.requests.order("mixer/speed/@set", b"7")
    assert known["outcome"] == "unclear"


@pytest.mark.parametrize(
    ("end", "why"),
    [
        ("]", "the answer is none of a gateway"),
        ("[]", "the answer is none of a gateway"),
        (json.dumps({"samples": 0}), "the answer is none of a gateway"),
        (json.dumps({"samples": 1, "complete": True, "next": ""}), "not all samples"),
        (json.dumps({"samples": 0, "complete": False, "next": "a"}), "does not go on"),
    ],
)
async def test_a_history_of_another_program_is_refused(end: str, why: str) -> None:
    async with plant(lambda query: query.reply("plant/@gateway/demo/page", end)) as remote:
        with pytest.raises(GatewayError, match=why):
            [page async for page in remote.past("mixer/speed", "[..]")]


@pytest.mark.parametrize(
    "aggregate", [None, "AggregateFunction_Average", "AggregateFunction_Range"]
)
async def test_opc_ua_tells_no_history_as_good_that_damage_has_touched(
    aggregate: str | None,
) -> None:
    end = {"samples": 0, "complete": True, "next": "a", "damaged": "70 samples are damaged"}
    begin, until = datetime(2026, 1, 1, tzinfo=UTC), datetime(2026, 1, 2, tzinfo=UTC)
    asked = ua.HistoryReadParameters(NodesToRead=[ua.HistoryReadValueId(SPEED)])
    if aggregate is None:
        asked.HistoryReadDetails = ua.ReadRawModifiedDetails(False, begin, until)
    else:
        of = [ua.NodeId(getattr(ua.ObjectIds, aggregate))]
        asked.HistoryReadDetails = ua.ReadProcessedDetails(begin, until, 3_600_000.0, of)

    def damaged(query: zenoh.Query) -> None:
        if "page" in query.parameters:
            query.reply("plant/@gateway/demo/page", json.dumps(end))

    async with plant(damaged) as remote:
        remote.tags["mixer/speed"] = META | {"history": True}
        [result] = await History(InternalServer(), remote).read_history(asked)
    assert result.StatusCode.value == ua.StatusCodes.BadDataLost


@pytest.mark.parametrize(
    "about",
    [
        {"type": 7},
        {"unit": ["rpm"]},
        {"description": None},
        {"length": -1},
        {"length": MOST_ELEMENTS + 1},
        {"length": "2"},
        {"write": True},
        {"write": {"min": "0"}},
        {"clamp": [0, 1]},
        {"range": 5},
        {"history": "yes"},
    ],
    ids=str,
)
def test_a_description_that_no_bridge_can_use_is_none(about: dict[str, object]) -> None:
    later = {"added": {"later": 1}}
    assert described_by("mixer/speed", json.dumps(META | later).encode()) == META | later
    assert described_by("mixer/speed", json.dumps(META | about).encode()) is None
