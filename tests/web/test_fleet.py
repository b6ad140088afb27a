"""The view of all gateways under the prefix, in the JSON API and in a browser."""

import gzip
import json
import time
from collections.abc import AsyncIterator, Iterator
from functools import partial
from pathlib import Path

import pytest

from gateway.config import load
from gateway.config.loading import dumped
from gateway.errors import GatewayError
from gateway.parts.web.fleet import api, files
from tests.cli.test_fleet import FILE, REPORT
from tests.conftest import needs
from tests.web.browser import Tab, browser
from tests.web.serving import Client, serving
from tests.web.test_page import text, texts
from tests.zenoh_peer import TIMEOUT


def reports(**changed: dict[str, object]) -> Iterator[tuple[str, bytes, float]]:
    """Yields the report of each named gateway, with other fields."""
    now = time.time()
    at = time.strftime("%Y-%m-%dT%H:%M:%S.000000Z", time.gmtime(now))
    for name, fields in changed.items():
        payload = json.dumps({**REPORT, "name": name, "time": at, **fields}).encode()
        yield f"works/north/@gateway/{name}/report", payload, now


FAULT: dict[str, object] = {"fault": "mixer is silent", "faults": {"device-silent": 1}}
THREE = partial(
    reports, good={}, sick=FAULT, old={"version": "1.1.0", "group": "hall", "stand": "standby"}
)


@pytest.fixture(autouse=True)
def asked_each_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(api, "ASK_EVERY", 0.0)


@pytest.fixture
async def tab(tmp_path: Path) -> AsyncIterator[Tab]:
    async with browser(needs("chromium"), tmp_path / "profile") as found:
        await found.look(1366, 768)
        yield found
        assert found.errors == []


async def states(client: Client) -> dict[str, str]:
    found = (await client.ask("/api/fleet")).json
    return {one["gateway"]: one["state"] for one in found["gateways"]}


async def test_the_api_has_all_gateways_and_those_that_replied_before() -> None:
    async with serving(fleet=True) as client:
        client.north.fleet = THREE
        assert await states(client) == {
            "works/north/sick": "fault",
            "works/north/old": "look",
            "works/north/good": "good",
        }
        client.north.fleet = partial(reports, good={})
        assert [*(await states(client)).values()] == ["missing", "missing", "good"]
        packed = await client.ask("/api/fleet", Accept_Encoding="gzip")
        assert packed.headers["Content-Encoding"] == "gzip"
        assert json.loads(gzip.decompress(packed.body))["mistakes"] == []


async def test_damaged_reports_are_mistakes_and_hide_no_other() -> None:
    def broken() -> Iterator[tuple[str, bytes, float]]:
        yield "works/@gateway/bad/report", b"{}", 0.0
        yield from THREE()

    async with serving(fleet=True) as client:
        client.north.fleet = broken
        found = (await client.ask("/api/fleet")).json
        assert len(found["gateways"]) == 3
        assert found["mistakes"][0].startswith("works/bad: its report cannot be read")


async def test_the_files_of_a_folder_are_compared_and_read_again_after_a_change(
    tab: Tab, tmp_path: Path
) -> None:
    (folder := tmp_path / "files").mkdir()
    file = folder / "good.yaml"
    north = FILE | {"zenoh": {"prefix": "works/north"}}
    file.write_text(dumped(north | {"gateway": {"name": "good"}}))
    (folder / "gone.yaml").write_text(dumped(FILE | {"gateway": {"name": "gone"}}))
    (folder / "other.yaml").write_text(dumped(FILE | {"zenoh": {"prefix": "elsewhere"}}))

    async def compared(client: Client) -> dict[str, str]:
        found = (await client.ask("/api/fleet")).json
        while found["mistakes"]:  # a slow machine: the next answer has them
            assert "are being read" in found["mistakes"][0]
            found = (await client.ask("/api/fleet")).json
        return {one["gateway"]: one["says"] for one in found["gateways"]}

    async with serving(fleet=folder) as client:
        sick = {**FAULT, "digest": "other"}
        client.north.fleet = partial(reports, good={"digest": load(file).digest}, sick=sick)
        assert await compared(client) == {
            "works/gone": "it never replied",
            "works/north/sick": "mixer is silent; no file of the folder is its own",
            "works/north/good": "",
        }
        file.write_text(file.read_text().replace("D0", "D1"))
        assert (await compared(client))["works/north/good"] == "its file differs from good.yaml"
        await tab.open(f"http://127.0.0.1:{client.port}/#fleet")
        await tab.until(f"{text('#fleet-drift')} === 'Files: no file 1 · differs 1'")
        assert "its file differs from good.yaml" in await tab.value(text("#fleet-list"))


async def test_a_folder_that_cannot_be_read_hides_no_gateway(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "PATIENCE", TIMEOUT)
    async with serving(fleet=tmp_path / "gone") as client:
        client.north.fleet = THREE
        found = (await client.ask("/api/fleet")).json
        assert len(found["gateways"]) == 3
        assert "No such file" in found["mistakes"][0]


async def test_many_clients_ask_the_gateways_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(api, "ASK_EVERY", 3600.0)
    async with serving(fleet=True) as client:
        client.north.fleet = THREE
        for _ in range(3):
            await states(client)
        assert client.north.asked == 1


async def test_a_session_that_is_not_open_is_said() -> None:
    def closed() -> Iterator[tuple[str, bytes, float]]:
        raise GatewayError("the Zenoh session is not open")

    async with serving(fleet=True) as client:
        client.north.fleet = closed
        refused = await client.ask("/api/fleet")
        assert (refused.status, refused.json["error"]) == (503, "the Zenoh session is not open")


async def test_without_the_setting_there_is_no_fleet() -> None:
    async with serving() as client:
        for path in ("/api/fleet", "/fleet.js", "/fleet.css"):
            assert (await client.ask(path)).status == 404
        assert b"fleet.js" not in (await client.ask("/")).body


async def test_the_map_has_the_worst_first_and_words_and_states_find(tab: Tab) -> None:
    async with serving(fleet=True) as client:
        client.north.fleet = THREE
        await tab.open(f"http://127.0.0.1:{client.port}/#overview")
        await tab.until("document.body.className === ''")
        assert client.north.asked == 0  # nothing is asked while nobody looks
        await tab.click('nav a[href="#fleet"]')
        await tab.until(f"{texts('#fleet-map li')}.length === 3")
        assert await tab.value(texts("#fleet-map li")) == ["! sick", "? old", "good"]
        assert await tab.value(texts("#fleet-list .name")) == ["sick", "old", "good"]
        assert await tab.value(texts("#fleet-states button")) == [
            "1 fault",
            "1 to look at",
            "1 good",
        ]
        assert "version 1.1.0 is old" in await tab.value(text("#fleet-list"))
        assert await tab.value(text("#fleet-faults")) == "Faults: device-silent 1"
        assert await tab.value(text("#fleet-versions")) == "Versions: 1.2.0 2 · 1.1.0 1"
        assert await tab.value(text("#fleet-standby")) == "Standby groups: hall: standby 1"
        await tab.click("#fleet-states .look")
        assert await tab.value(texts("#fleet-list .name")) == ["old"]
        await tab.click("#fleet-states .look")
        await tab.value("document.getElementById('fleet-find').focus()")
        await tab.type("silent")
        assert await tab.value(texts("#fleet-list .name")) == ["sick"]
        await tab.click("#fleet-map .good a")
        assert await tab.value(texts("#fleet-list .name")) == ["good"]


async def test_what_is_old_says_so_and_names_are_text(
    tab: Tab, monkeypatch: pytest.MonkeyPatch
) -> None:
    evil = "<img src=x onerror=alert(1)>"
    async with serving(fleet=True) as client:
        client.north.fleet = partial(
            reports, good={}, sick={**FAULT, "fault": evil, "group": evil, "stand": evil}
        )
        await tab.open(f"http://127.0.0.1:{client.port}/#fleet")
        await tab.until(f"{text('#fleet-list')}.includes({json.dumps(evil)})")
        assert await tab.value("document.querySelector('#view-fleet img')") is None
        client.north.fleet = lambda: (_ for _ in ()).throw(GatewayError("no session"))
        await tab.until(f"{text('#fleet-more')}.startsWith('Not asked: no session')")
        assert await tab.value("document.getElementById('view-fleet').className") == "view old"
