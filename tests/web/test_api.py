"""The JSON API: its description, its pages, and what a write is answered with."""

import asyncio
import json
import os
import time
from pathlib import Path
from typing import Any

import pytest

from gateway.contract.payload import GroupResult
from gateway.contract.problems import Failure, Problem
from gateway.parts.web.server import Server
from gateway.tags import AlarmRule, Level, WriteResult, good
from gateway.tags.sample import uncertain
from gateway.tags.shaping import Bounds
from tests.conftest import needs
from tests.e2e.processes import ROOT
from tests.history.recorded import SPEED, history
from tests.northbound.plant import PlainDevice, PlainPlant, mixer, tag
from tests.schema_check import violations
from tests.web.serving import (
    TOKEN,
    Client,
    PlainNorth,
    calling,
    core_of,
    local,
    serving,
    transfer,
)

DESCRIBED = Server(local(), core_of(mixer(), PlainNorth())).description
AS_JSON = {"Content_Type": "application/json", "Authorization": f"Bearer {TOKEN}"}


def schema(path: str, status: int, method: str = "get") -> dict[str, Any]:
    """The schema of an answer, with the definitions that it refers to."""
    answer = DESCRIBED["paths"][path][method]["responses"][str(status)]
    found = {**answer["content"]["application/json"]["schema"]}
    found["$defs"] = DESCRIBED["components"]["schemas"]
    renamed: dict[str, Any] = json.loads(
        json.dumps(found).replace("#/components/schemas/", "#/$defs/")
    )
    return renamed


async def test_the_description_is_served_and_valid() -> None:
    async with serving() as client:
        answer = await client.ask("/openapi.json")
        assert (answer.status, answer.json) == (200, DESCRIBED)
        assert answer.headers["Content-Type"].startswith("application/json")
    from openapi_spec_validator import validate

    validate(DESCRIBED)


@pytest.mark.parametrize(
    ("address", "path", "status"),
    [
        ("/api/status", "/api/status", 200),
        ("/api/lines", "/api/lines", 200),
        ("/api/transfers", "/api/transfers", 200),
        ("/api/transfers?after=x", "/api/transfers", 400),
        ("/api/devices", "/api/devices", 200),
        ("/api/devices?line=hall&limit=1", "/api/devices", 200),
        ("/api/devices?limit=0", "/api/devices", 400),
        ("/api/devices/oven", "/api/devices/{device}", 200),
        ("/api/devices/none", "/api/devices/{device}", 404),
        ("/api/tags", "/api/tags", 200),
        ("/api/tags?limit=1001", "/api/tags", 400),
        ("/api/tags?device=none", "/api/tags", 404),
        ("/api/history?tag=mixer/speed", "/api/history", 404),
        ("/api/alarms?state=all&limit=1", "/api/alarms", 200),
        ("/api/alarms?state=none", "/api/alarms", 400),
    ],
)
async def test_an_answer_is_as_described(address: str, path: str, status: int) -> None:
    async with serving() as client:
        answer = await client.ask(address)
        assert answer.status == status
        assert violations(answer.json, schema(path, status)) == []


async def test_the_pages_of_a_list_have_every_tag_once() -> None:
    async with serving() as client:
        found: list[str] = []
        after = ""
        while after is not None:
            page = (await client.ask(f"/api/tags?limit=1{after and '&after=' + after}")).json
            found += [one["tag"] for one in page["tags"]]
            after = page["next"]
        assert found == ["mixer/speed", "mixer/alarms/door", "mixer/recipe", "oven/temperature"]
        some = (await client.ask("/api/tags?find=DOOR")).json["tags"]
        assert [one["tag"] for one in some] == ["mixer/alarms/door"]


async def test_transfers_are_in_pages_by_number() -> None:
    async with serving() as client:
        stale = transfer("stale", code="A", meaning="no response", why="mixer/speed is bad")
        rows = {2: stale, 10: transfer("carried", value=[1, 2], last_carried=3.5), 3: stale}
        client.north.changed |= {f"transfers/{number}": one for number, one in rows.items()}
        client.north.changed["lines/far"] = calling()
        first = (await client.ask("/api/transfers?limit=2")).json
        assert violations(first, schema("/api/transfers", 200)) == []
        assert ([one["transfer"] for one in first["transfers"]], first["next"]) == ([2, 3], "3")
        last = (await client.ask(f"/api/transfers?after={first['next']}")).json
        assert violations(last, schema("/api/transfers", 200)) == []
        assert ([one["transfer"] for one in last["transfers"]], last["next"]) == ([10], None)
        lines = (await client.ask("/api/lines")).json
        assert violations(lines, schema("/api/lines", 200)) == []


async def test_history_is_answered_as_described(tmp_path: Path) -> None:
    now = time.time_ns()
    plant = PlainPlant(PlainDevice(SPEED.device, (SPEED,)))
    with history(tmp_path / "history.db") as historian:
        historian.record([good(SPEED, number, now - 10**9 + number) for number in range(5)])
        async with serving(history=historian, plant=plant) as client:
            answer = await client.ask(f"/api/history?tag={SPEED.key}&limit=3")
            assert violations(answer.json, schema("/api/history", 200)) == []
            assert [one["value"] for one in answer.json["samples"]] == [0, 1, 2]
            assert answer.json["complete"] is False
            whole = await client.ask(f"/api/history?tag={SPEED.key}&limit=6")
            assert whole.json["complete"] is True
            wrong = await client.ask(f"/api/history?tag={SPEED.key}&time=yesterday")
            assert (wrong.status, "no range" in wrong.json["error"]) == (400, True)
            last = await client.ask(f"/api/history?tag={SPEED.key}&last=2")
            assert [one["value"] for one in last.json["samples"]] == [3, 4]


async def test_buckets_are_answered_as_described(tmp_path: Path) -> None:
    now = time.time_ns()
    plant = PlainPlant(PlainDevice(SPEED.device, (SPEED,)))
    with history(tmp_path / "history.db") as historian:
        historian.record([good(SPEED, 4, now - 20 * 10**9), good(SPEED, 8, now - 15 * 10**9)])
        async with serving(history=historian, plant=plant) as client:
            chart = f"/api/history?tag={SPEED.key}&time=[now(-1h)..now(-10s)]&bucket=1d"
            answer = (await client.ask(chart)).json
            assert violations(answer, schema("/api/history", 200)) == []
            known = [
                one for one in answer["buckets"] if one["quality"] != "bad"
            ]  # of one day or two
            assert (known[0]["quality"], known[-1]["last"]) == ("partial", 8)
            found = (await client.ask(f"{chart}&agg=last&quality=good")).json["buckets"]
            assert all(one["quality"] == "good" for one in found)
            wrong = await client.ask(f"{chart}&agg=average")
            assert (wrong.status, "is none of min, max" in wrong.json["error"]) == (400, True)
            # The plant has read nothing yet, so no value is valid until now.
            until_now = await client.ask(f"/api/history?tag={SPEED.key}&bucket=1d")
            assert until_now.json["buckets"][-1]["known"] <= 5.1


DONE = WriteResult(7, 0, 0.03, verified=True)
ENDINGS = [
    (DONE, 200),
    (Failure(Problem.BAD_VALUE, "41 is above max 40"), 400),
    (Failure(Problem.NOT_WRITABLE, "no `write`"), 403),
    (Failure(Problem.UNKNOWN_TAG, "no tag"), 404),
    (Failure(Problem.REFUSED, "refused with 28", "28"), 502),
    (Failure(Problem.BUSY, "too many"), 503),
    (Failure(Problem.LINE_DOWN, "no such port"), 503),
    (Failure(Problem.NO_REPLY, "offline"), 503),
    (Failure(Problem.UNCLEAR, "it may be done"), 504),
    (GroupResult({"recipe": DONE, "run": DONE}, 0.1), 200),
    (GroupResult({"recipe": DONE, "run": Failure(Problem.NOT_SENT, "recipe")}, 0.1), 502),
    (GroupResult({"recipe": Failure(Problem.NOT_WRITABLE, "no `write`")}, 0.1), 403),
]


@pytest.mark.parametrize(("result", "status"), ENDINGS)
async def test_only_an_acknowledged_write_is_answered_with_200(
    result: WriteResult | Failure | GroupResult, status: int, tokens: Path
) -> None:
    async with serving(tokens_file=tokens) as client:
        client.north.endings[b"7"] = result
        answer = await client.ask("/api/write?tag=mixer/recipe", "POST", b"7", **AS_JSON)
        assert answer.status == status
        assert violations(answer.json, schema("/api/write", status, "post")) == []
        assert client.north.written == [("mixer/recipe", b"7", "web alice")]


async def test_a_write_needs_a_token_and_a_body_that_no_form_of_another_site_sends(
    tokens: Path,
) -> None:
    async with serving(tokens_file=tokens) as client:
        for headers, status in (
            ({"Content_Type": "application/json"}, 401),
            ({**AS_JSON, "Authorization": "Bearer " + TOKEN[:-1]}, 401),
            ({**AS_JSON, "Origin": "http://evil.example"}, 403),
            ({**AS_JSON, "Sec_Fetch_Site": "cross-site"}, 403),
            ({**AS_JSON, "Content_Type": "text/plain"}, 415),
        ):
            answer = await client.ask("/api/write?tag=mixer/recipe", "POST", b"7", **headers)
            assert answer.status == status
        assert client.north.written == []
    async with serving() as client:
        answer = await client.ask("/api/write?tag=mixer/recipe", "POST", b"7", **AS_JSON)
        assert (answer.status, client.north.written) == (403, [])


async def test_a_write_goes_on_when_its_client_leaves(tokens: Path) -> None:
    async with serving(tokens_file=tokens) as client:
        client.north.gate.clear()
        asking = asyncio.create_task(
            client.ask("/api/write?tag=mixer/recipe", "POST", b"7", **AS_JSON)
        )
        async with asyncio.timeout(300):
            await client.north.began.wait()
        asking.cancel()
        await asyncio.gather(asking, return_exceptions=True)
        client.north.gate.set()
        async with asyncio.timeout(300):
            while not client.north.written:
                await asyncio.sleep(0.001)


async def test_a_body_that_does_not_arrive_is_not_waited_for(
    tokens: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gateway.parts.web.routes.BODY_WITHIN", 0.05)
    async with serving(tokens_file=tokens) as client:
        address = "/api/write?tag=mixer/recipe"
        answer = await client.ask(address, "POST", b"", Content_Length="9", **AS_JSON)
        assert answer.status == 408
        assert client.north.written == []


async def events(client: Client, query: str, last: str = "") -> "dict[str, Any]":
    """The first event of each kind, and `id`. `last`: of the header Last-Event-ID."""
    reader, writer = await asyncio.open_connection("127.0.0.1", client.port)
    found: dict[str, Any] = {}
    try:
        head = f"Host: 127.0.0.1\r\nLast-Event-ID: {last}\r\n\r\n"
        writer.write(f"GET /api/events?{query} HTTP/1.1\r\n{head}".encode())
        async with asyncio.timeout(300):
            while not {"state", "time"} <= {*found}:
                line = await reader.readline()
                if line.startswith(b"id: "):
                    found["id"] = line[4:].strip().decode()
                if line.startswith(b"event: "):
                    kind = line[7:].strip().decode()
                    found[kind] = json.loads((await reader.readline()).removeprefix(b"data: "))
    finally:
        writer.close()
        await writer.wait_closed()
    return found


async def test_the_page_gets_large_integers_as_text_and_no_text_of_a_bad_value() -> None:
    plant = PlainPlant(PlainDevice("big", (tag("big", "count"), tag("big", "unread"))))
    plant.now("big/count", 2**53 + 1)
    async with serving(plant=plant) as client:
        found = await events(client, "tags=big/*")
    [count, unread] = found["values"]
    assert count[:3] == ["big/count", "9007199254740993", "good"]
    assert unread[:3] == ["big/unread", "", "bad"]
    assert unread[4] == "starting"
    assert found["state"]["devices"]["oven"][1:] == [
        "silent",
        "No byte came back: check power, wiring and station number",
    ]


async def test_a_client_that_comes_again_gets_what_it_missed(tmp_path: Path) -> None:
    now = time.time_ns()
    plant = PlainPlant(PlainDevice(SPEED.device, (SPEED, tag(SPEED.device, "without"))))
    with history(tmp_path / "history.db") as historian:
        historian.record([good(SPEED, number, now - (5 - number) * 10**9) for number in range(5)])
        async with serving(history=historian, plant=plant) as client:
            first = await events(client, f"tags={SPEED.device}/*")
            assert "missed" not in first
            assert abs(int(first["id"]) - time.time() * 1000) < 300_000
            since = str(now // 10**6 - 2_500)
            again = await events(client, f"tags={SPEED.device}/*", since)
            assert list(again)[:2] == ["missed", "values"]
            assert again["missed"]["tag"] == SPEED.key
            assert [one["value"] for one in again["missed"]["samples"]] == [3, 4]
            assert again["missed"]["complete"] is True
            for odd in ("x", "-1", "9" * 30):
                assert "missed" not in await events(client, f"tags={SPEED.device}/*", odd)


async def test_a_line_is_watched_only_while_a_page_shows_it() -> None:
    async with serving() as client:
        reader, writer = await asyncio.open_connection("127.0.0.1", client.port)
        writer.write(b"GET /api/events?line=hall HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        async with asyncio.timeout(300):
            await reader.readuntil(b"event: time")
            assert client.plant.hall.active
            writer.close()
            await writer.wait_closed()
            while client.plant.hall.active:
                await asyncio.sleep(0.001)


async def test_a_page_that_takes_nothing_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gateway.parts.web.events.SLOW", 0.2)
    monkeypatch.setattr("gateway.parts.web.events.WIRE_EVERY", 0.0)
    monkeypatch.setattr("gateway.parts.web.events.STATE_EVERY", 0.0)
    async with serving() as client:
        refused = ["D512..D519 of mixer: refused with 28 " + "x" * 1000] * 50
        known = {"standing": "up", "diagnosis": "", "refused_addresses": refused}
        client.north.changed["devices/mixer"] = known
        _, writer = await asyncio.open_connection("127.0.0.1", client.port, limit=1024)
        writer.write(b"GET /api/events?line=hall HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        async with asyncio.timeout(300):
            while not client.plant.hall.active:
                await asyncio.sleep(0.001)
            while client.plant.hall.active:  # the reader takes 2 kB, then nothing
                await asyncio.sleep(0.01)
        assert (await client.ask("/healthz")).status == 200
        writer.close()


def alarmed() -> PlainPlant:
    rule = AlarmRule({Level.HIGH: 80}, text="too fast")
    tags = [tag("mixer", name, alarm=rule) for name in ("speed", "level", "flow")]
    plant = PlainPlant(PlainDevice("mixer", tuple(tags)))
    for one in tags[:2]:
        plant.samples[one.key] = good(one, 85, 5)
    return plant


async def test_alarms_are_listed_in_pages() -> None:
    plant = alarmed()
    plant.alarms.judge([plant.samples["mixer/speed"], plant.samples["mixer/level"]])
    async with serving(plant=plant) as client:
        first = (await client.ask("/api/alarms?limit=1")).json
        second = (await client.ask(f"/api/alarms?limit=1&after={first['next']}")).json
        both = {one["alarm"] for page in (first, second) for one in page["alarms"]}
        assert (both, second["next"]) == ({"mixer/speed", "mixer/level"}, None)
        assert first["counts"] == {
            "normal": 1,
            "active": 2,
            "acknowledged": 0,
            "returned": 0,
            "shelved": 0,
            "out_of_service": 0,
        }
        assert violations(first, schema("/api/alarms", 200)) == []
        assert len((await client.ask("/api/alarms?state=all")).json["alarms"]) == 3


async def test_an_alarm_is_shelved_and_listed_as_such(tokens: Path) -> None:
    body = b'{"by": "Ana", "do": "shelve", "reason": "broken", "seconds": 60}'
    path = "/api/alarms/order?alarm=mixer/speed"
    async with serving(plant=alarmed(), tokens_file=tokens) as client:
        client.north.orders = client.plant.parts.alarms.order
        assert (await client.ask(path, "POST", body, Content_Type="application/json")).status == 401
        done = await client.ask(path, "POST", body, **AS_JSON)
        assert (done.status, done.json["shelved"]["reason"]) == (200, "broken")
        assert violations(done.json, schema("/api/alarms/order", 200, "post")) == []
        found = (
            await client.ask("/api/alarms?state=suppressed", Authorization=AS_JSON["Authorization"])
        ).json["alarms"]
        assert [one["alarm"] for one in found] == ["mixer/speed"]


async def test_past_alarms_come_newest_first_and_without_history_that_is_said(
    tmp_path: Path,
) -> None:
    path = "/api/alarms/past?time=%5Bnow(-1h)..%5D&limit=2"
    plant = alarmed()
    async with serving(plant=plant) as client:
        assert (await client.ask(path)).status == 503
    with history(tmp_path / "history.db") as historian:
        async with serving(plant=plant, history=historian) as client:
            entries, at = plant.alarms.entries, time.time_ns()
            for number, key in enumerate(("mixer/speed", "mixer/level", "mixer/flow")):
                tag_ = entries[key].tag
                assert tag_ is not None
                plant.alarms.judge([good(tag_, 85, at + number)])
            found = await client.ask(path)
            assert [one["alarm"] for one in found.json["alarms"]] == ["mixer/flow", "mixer/level"]
            assert violations(found.json, schema("/api/alarms/past", 200)) == []
            assert (await client.ask("/api/alarms/past?time=now")).status == 400


async def test_an_alarm_is_acknowledged_with_a_token_only(tokens: Path) -> None:
    path = "/api/alarms/acknowledge?alarm=mixer/speed"
    body = b'{"by": "Ana"}'
    async with serving(tokens_file=tokens) as client:
        assert (await client.ask(path, "POST", body, Content_Type="application/json")).status == 401
        assert (await client.ask(path, "POST", body, **AS_JSON)).status == 409
        assert client.north.written == [("mixer/speed", body, "web alice")]


async def javascript(client: Client, *arguments: str) -> tuple[str, int | None]:
    """Runs the example for JavaScript. Returns what it prints, and its exit code."""
    command = (needs("node"), str(ROOT / "examples" / "read_and_write.mjs"))
    address = f"http://127.0.0.1:{client.port}"
    known = {**os.environ, "GATEWAY_TOKEN": TOKEN}
    ran = await asyncio.create_subprocess_exec(
        *command, address, *arguments, stdout=asyncio.subprocess.PIPE, env=known
    )
    printed, _ = await ran.communicate()
    return printed.decode(), ran.returncode


async def test_the_example_for_javascript_shows_no_value_that_is_not_good(tokens: Path) -> None:
    speed = tag("mixer", "speed", unit="rpm", range=Bounds(0, 50))
    played = tag("mixer", "played").with_origin("replayed")
    lost, recipe = tag("mixer", "lost"), tag("mixer", "recipe")
    plant = PlainPlant(PlainDevice("mixer", (speed, played, lost, recipe)))
    plant.now("mixer/speed", 12)
    plant.now("mixer/played", 3)
    async with serving(plant=plant, tokens_file=tokens) as client:
        client.north.endings[b"7"] = WriteResult(7, 0, 0.1)
        client.north.endings[b"8"] = Failure(Problem.UNCLEAR, "no reply")
        client.north.endings[b"9"] = Failure(Problem.BAD_VALUE, "9 is too large")
        ran = await asyncio.gather(
            javascript(client, "mixer/speed", "7", "0.1"),
            javascript(client, "mixer/played", "8", "0.1"),
            javascript(client, "mixer/lost", "9", "0.1"),
        )
        plant.samples["mixer/speed"] = uncertain(good(speed, 60, 1))
        last = await javascript(client, "mixer/speed", "7", "0.1")
    assert [*ran, last] == [
        ("12 rpm\nwritten: 7\n", 0),
        ("not real: 3\nunclear\n", 1),
        ("not good: bad, starting\nnot written: 9 is too large\n", 1),
        ("not good: uncertain, out-of-range\nwritten: 7\n", 0),
    ]
