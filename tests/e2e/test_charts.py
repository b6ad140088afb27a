"""Charts of a real gateway: buckets of an earlier life and of this one, over Zenoh and HTTP."""

import asyncio
import json
import time
import urllib.parse
import urllib.request
from contextlib import closing
from pathlib import Path
from typing import Any

from gateway.parts.history.store.file import HistoryFile
from gateway.tags import good
from tests.e2e.processes import free_port, started, vigor_line, write_config
from tests.history_writer import tag
from tests.zenoh_peer import ZenohPeer, free_endpoint

SECOND = 10**9
SPEED = "plant/mixer/speed"


async def test_the_time_without_a_gateway_is_a_gap(tmp_path: Path) -> None:
    now, history, port = time.time_ns(), tmp_path / "history.db", free_port()
    with closing(HistoryFile(history, 10**8)) as file:
        # The earlier gateway ended 1000 s after the last change of the speed.
        earlier = [
            good(tag("speed").with_origin("simulated"), 5, now - 4000 * SECOND),
            good(tag("n").with_origin("simulated"), 1, now - 3000 * SECOND),
        ]
        file.store(1, earlier)
    tags = {"speed": {"address": "D{first}"}, "n": {"address": "D{first + 1}"}}
    template = {"parameters": ["first"], "defaults": {"history": True}, "tags": tags}
    line = vigor_line("simulator", {})
    line["devices"]["mixer"] |= {"use": "plc", "first": 10}
    endpoint = free_endpoint()
    config = write_config(
        tmp_path / "config.yaml",
        endpoint,
        {"hall": line},
        templates={"plc": template},
        history={"path": str(history)},
        web={"listen": f"127.0.0.1:{port}"},
    )
    with started(config) as program:
        async with ZenohPeer("client", connect=[endpoint]) as client:
            await client.get(f"{SPEED}?max_age=0s")
            asked = f"{SPEED}?_time=[now(-4100s)..];bucket=500s"
            found = [reply.json for reply in await client.get(asked)]
            known = sum(bucket["known"] for bucket in found)
            assert 999 < known < 1001 + (time.time_ns() - now) / SECOND
            gap = [bucket for bucket in found if bucket["quality"] == "bad"]
            assert len(gap) >= 4
            assert all(
                (bucket["mean"], bucket["last"], bucket["reason"]) == (None, None, "not-recorded")
                for bucket in gap
            )
            [newest] = await client.get(f"{SPEED}?last=1;quality=good")
            assert newest.json["quality"] == "good"
            [wrong] = await client.get(f"{SPEED}?_time=[..];bucket=1s;agg=average")
            assert wrong.json["error"] == "bad-query"
            assert "is none of min, max, mean, last" in wrong.json["reason"]
        same = await asyncio.to_thread(_http, port, "[now(-4100s)..]", "500s")
        assert [one["quality"] for one in same["buckets"]][1:-1] == [
            one["quality"] for one in found
        ][1:-1]
        assert program.end() == 0


def _http(port: int, period: str, bucket: str) -> Any:
    query = urllib.parse.urlencode({"tag": "mixer/speed", "time": period, "bucket": bucket})
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/api/history?{query}", timeout=60) as page:
        return json.load(page)
