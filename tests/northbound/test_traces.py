"""The trace of a line: watched from its first subscriber to the end of the last."""

import asyncio
import json

import zenoh

from gateway.config import ZenohConfig
from gateway.line.wire_log import Piece
from gateway.northbound.publishing.traces import MOST_WAITING, Tap
from tests.northbound.plant import mixer, serving
from tests.zenoh_peer import free_endpoint

KEY = "plant/@gateway/demo/lines/hall/@trace"


async def _until(active: bool, log: object) -> None:
    async with asyncio.timeout(300):
        while log.active is not active:  # type: ignore[attr-defined]
            await asyncio.sleep(0.001)


async def test_a_line_is_watched_only_while_a_client_subscribes_to_its_trace() -> None:
    plant, endpoint = mixer(), free_endpoint()
    async with serving(plant, ZenohConfig(listen=(endpoint,))):
        setup = zenoh.Config()
        setup.insert_json5("mode", '"client"')
        setup.insert_json5("connect/endpoints", json.dumps([endpoint]))
        with await asyncio.to_thread(zenoh.open, setup) as session:
            of_all = session.declare_subscriber("plant/@gateway/**")
            first, second = (session.declare_subscriber(KEY) for _ in range(2))
            await _until(True, plant.hall)
            plant.hall.sent(b"\x02\x30")
            sample = await asyncio.to_thread(first.recv)
            [event] = json.loads(sample.payload.to_bytes())["events"]
            assert (event["way"], event["bytes"]) == (">", "02 30")
            first.undeclare()  # type: ignore[no-untyped-call]
            second.undeclare()  # type: ignore[no-untyped-call]
            await _until(False, plant.hall)  # a client of all status keys does not start it
            of_all.undeclare()  # type: ignore[no-untyped-call]


async def test_events_beyond_the_limit_are_counted_and_not_kept() -> None:
    put: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()
    tap = Tap(put.set_result)
    for _ in range(MOST_WAITING + 3):
        tap.take(Piece("<", b"\x00"))
    document = json.loads(await put)
    assert (len(document["events"]), document["missed"]) == (MOST_WAITING, 3)
    tap.close()
