"""The bench: the draft of a file, a change that goes back by itself, who may enter, the page."""

import asyncio
import math
import time
from pathlib import Path
from typing import Any

import aiohttp
import pytest

from gateway.cli.bench.draft import Draft
from gateway.cli.bench.line import Scan
from gateway.cli.bench.running import Running
from gateway.cli.bench.trial import Trial
from gateway.cli.client import connected
from gateway.cli.config.new import NamedStation
from gateway.cli.line.scan import Found
from gateway.config import Config, ConfigErrors, load
from gateway.errors import ConfigError, GatewayError
from gateway.plant.threads import off_loop
from gateway.protocols.vigor import Vigor
from gateway.stations.vigor import VigorStation
from gateway.transport import SerialSettings
from tests.cli.bench_page import BenchPage, benched, shown
from tests.conftest import needs
from tests.web.browser import browser

HUMAN = """\
# hall 1, see drawing 4711
gateway: {name: demo}   # mine
lines:
  hall-1:
    port: /dev/ttyUSB0
    devices:
      mixer: {protocol: vigor, station: 1}  # the old one

# the end
"""
SERIAL = SerialSettings(19200, "7E1")
STATION = NamedStation("oven", Found(SERIAL, Vigor(station=7), {}))
SHEET = b"Marke;Adresse;Einheit;Raum\nspeed;D100;rpm;4\nlevel;D102;mm;5\n"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "plant.yaml"
    path.write_text(HUMAN)
    return path


def add(draft: Draft, line: str = "hall-2") -> None:
    draft.add_line("demo", line, "/dev/ttyUSB1", [STATION], "tcp/127.0.0.1:1", simulated=False)


# -- the draft --


def test_a_line_and_a_tag_come_into_the_text_and_the_rest_stays(path: Path) -> None:
    draft = Draft(path)
    add(draft)
    draft.add_tags("mixer", {"speed": {"address": "D100", "type": "int16"}})
    shown = draft.document()
    assert path.read_text() == HUMAN
    assert [line for line in HUMAN.splitlines() if line not in draft.text] == [
        "      mixer: {protocol: vigor, station: 1}  # the old one"  # it became a block
    ]
    assert "      mixer:  # the old one\n" in draft.text
    assert (shown["size"], shown["mistakes"], shown["steps"]) == ("1 tag on 2 lines", [], 2)
    assert [one["line"] for one in shown["lines"]] == ["hall-1", "hall-2"]
    assert (shown["lines"][0]["before"], shown["lines"][1]["before"]) == (0.0, None)
    assert shown["lines"][0]["load"] > 0
    assert "+          speed: {address: D100, type: int16}" in shown["difference"]
    draft.back()
    draft.back()
    assert draft.text == HUMAN
    assert not draft.document()["changed"]


def test_a_file_that_is_not_there_begins_with_its_first_line(tmp_path: Path) -> None:
    draft = Draft(tmp_path / "new.yaml")
    assert draft.document()["exists"] is False
    add(draft)
    assert draft.config().lines[0].serial == SERIAL
    assert draft.config().zenoh.listen == ("tcp/127.0.0.1:1",)
    assert [*tmp_path.iterdir()] == []


@pytest.mark.parametrize(
    ("device", "tags", "says"),
    [
        ("mixer", {"speed": {"address": "D99999"}}, "D99999"),
        ("mixer", {"a b": {"address": "D1"}}, "space"),
        ("oven", {"speed": {"address": "D1"}}, "there is no device oven"),
        ("mixer", {"speed": {"address": "D1", "exec": "rm"}}, "exec"),
    ],
)
def test_a_step_that_would_make_the_file_bad_changes_nothing(
    path: Path, device: str, tags: dict[str, Any], says: str
) -> None:
    draft = Draft(path)
    with pytest.raises(ConfigError, match=says):
        draft.add_tags(device, tags)
    assert draft.text == HUMAN
    with pytest.raises(ConfigErrors):
        add(draft, "hall-1")  # twice


def test_a_sheet_is_shown_before_it_is_taken_and_a_column_may_be_chosen(path: Path) -> None:
    draft = Draft(path)
    shown = draft.sheet("tags.csv", SHEET, "mixer", {})
    assert [one["setting"] for one in shown["columns"]] == ["", "address", "unit", ""]
    assert shown["rows"][0] == ["speed", "D100", "rpm", "4"]
    assert shown["mistakes"]
    shown = draft.sheet("tags.csv", SHEET, "mixer", {"name": "Marke"})
    assert [one["setting"] for one in shown["columns"]] == ["name", "address", "unit", ""]
    assert [one["title"] for one in shown["columns"]] == ["Marke", "Adresse", "Einheit", "Raum"]
    assert shown["tags"][0] == "speed: {address: D100, unit: rpm}"
    assert (shown["count"], shown["mistakes"]) == (2, [])
    assert draft.text == HUMAN
    assert draft.add_sheet("tags.csv", SHEET, "mixer", {"name": "Marke"}) == 2
    assert [tag.key for tag in draft.config().devices[0].tags] == ["mixer/speed", "mixer/level"]
    with pytest.raises(ConfigError, match="empty"):
        draft.sheet("tags.csv", b"", "mixer", {})


# -- the trial --


class PlainRunning(Running):
    """A gateway that takes every file over, but for those with a word."""

    def __init__(self, path: Path, refuses: str = "", state: str = "own") -> None:
        super().__init__(path)
        self.taken: list[str] = []
        self.wants_no = refuses
        self.is_there = state
        self.config = load(path)

    @property
    def state(self) -> str:
        return self.is_there

    async def take(self, config: Config) -> None:
        text = self._path.read_text()
        self.taken.append(text)
        if self.wants_no and self.wants_no in text:
            raise GatewayError("it does not want it")


def changed(path: Path) -> Draft:
    draft = Draft(path)
    draft.add_tags("mixer", {"speed": {"address": "D100"}})
    return draft


async def test_a_change_that_is_not_kept_goes_back_by_itself(path: Path) -> None:
    draft, running = changed(path), PlainRunning(path)
    trial = Trial(draft, running, within=0.0)
    await trial.apply()
    assert running.taken == [draft.text]
    while trial.left() is not None or len(running.taken) < 2:
        await asyncio.sleep(0)
    await trial.keep()  # too late: it waits for the way back, and changes nothing
    assert running.taken == [draft.text, HUMAN]
    assert path.read_text() == HUMAN
    assert trial.said == "The change was not kept: the file is as before."
    assert draft.is_new  # it may be mended and applied again
    assert [one.name for one in path.parent.iterdir()] == ["plant.yaml"]


async def test_a_kept_change_stays_and_the_file_before_is_beside_it(path: Path) -> None:
    draft = changed(path)
    trial = Trial(draft, PlainRunning(path))
    await trial.apply()
    assert trial.left() is not None
    with pytest.raises(ConfigError, match="keep the change before"):
        await trial.apply()
    await trial.keep()
    await trial.close()
    assert (path.read_text(), trial.left()) == (draft.text, None)
    assert path.with_name("plant.yaml.bak").read_text() == HUMAN


async def test_the_end_of_the_bench_goes_back(path: Path) -> None:
    trial = Trial(changed(path), PlainRunning(path))
    await trial.apply()
    await trial.close()
    assert path.read_text() == HUMAN


async def test_a_bench_that_was_killed_leaves_a_question_to_the_next(path: Path) -> None:
    draft = changed(path)
    await Trial(draft, PlainRunning(path)).apply()
    killed = path.read_text()
    trial = Trial(Draft(path), running := PlainRunning(path))
    assert trial.left() == math.inf
    await trial.close()  # a person has not answered
    assert path.read_text() == killed
    await trial.back()
    assert path.read_text() == HUMAN == running.taken[-1]


async def test_another_bench_of_the_file_takes_no_way_back(path: Path) -> None:
    one, other = (Trial(changed(path), PlainRunning(path)) for _ in range(2))
    await one.apply()
    with pytest.raises(ConfigError, match="another bench tries a change"):
        await other.apply()
    await other.close()
    await one.back()
    assert path.read_text() == HUMAN
    assert one.said == "The file is as before."
    await other.apply()
    await other.keep()


async def test_a_file_that_the_gateway_refuses_is_as_before_at_once(path: Path) -> None:
    running = PlainRunning(path, refuses="D100")
    trial = Trial(changed(path), running)
    with pytest.raises(GatewayError, match="does not want"):
        await trial.apply()
    assert path.read_text() == HUMAN == running.taken[-1]
    assert trial.left() is None
    first = Draft(path.with_name("new.yaml"))
    add(first)
    refusing = PlainRunning(path, refuses="port", state="")
    refusing._path = first.path
    with pytest.raises(GatewayError):
        await Trial(first, refusing).apply()
    assert not first.path.exists()


async def test_what_a_person_wrote_meanwhile_is_never_overwritten(path: Path) -> None:
    draft = changed(path)
    path.write_text(HUMAN + "# by hand\n")
    with pytest.raises(ConfigError, match="changed meanwhile"):
        await Trial(draft, PlainRunning(path)).apply()
    assert path.read_text() == HUMAN + "# by hand\n"
    draft = changed(path)
    trial = Trial(draft, PlainRunning(path))
    await trial.apply()
    path.write_text("# by hand too\n" + draft.text)
    await trial.back()
    assert "changed meanwhile" in trial.said
    assert path.read_text() == "# by hand too\n" + draft.text


async def test_a_folder_that_takes_no_file_ends_no_trial(path: Path) -> None:
    """Keep stopped the minute and kept nothing; the way back was tried once, and then forgotten."""
    draft, running = changed(path), PlainRunning(path)
    before, backup = (path.with_name(f"plant.yaml.{one}") for one in ("before", "bak"))
    trial = Trial(draft, running, within=0.05)
    await trial.apply()
    (backup / "full").mkdir(parents=True)
    with pytest.raises(ConfigError, match="cannot be written: Is a directory"):
        await trial.keep()
    aside = before.rename(path.with_name("aside"))
    while "could not go back" not in trial.said:
        await asyncio.sleep(0.01)
    assert trial.left() is not None
    with pytest.raises(ConfigError, match="keep the change before"):
        await trial.apply()
    aside.rename(before)
    while trial.said != "The change was not kept: the file is as before.":
        await asyncio.sleep(0.01)
    assert trial.left() is None
    assert path.read_text() == HUMAN == running.taken[-1]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (HUMAN, "does not watch it"),
        (HUMAN.replace("name: demo", "name: demo, watch_config: true"), ""),
    ],
)
async def test_the_gateway_of_another_person_must_watch_its_file(
    path: Path, text: str, says: str
) -> None:
    path.write_text(text)
    running = PlainRunning(path, state="other")
    why = running.why_not(load(path))
    assert says in why if says else why == ""
    assert "prefix changed" in running.why_not(load(path, text=text + "zenoh: {prefix: x}\n")) or (
        says
    )


# -- the scan --


async def test_a_port_that_is_taken_away_during_a_scan_loses_no_station_before(
    path: Path,
) -> None:
    station, asked = VigorStation(0), 0

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal asked
        while asked < 2 and (data := await reader.read(100)):
            asked += 1
            writer.write(b"".join(station.hear(data, 0.0)))
        writer.close()

    async with await asyncio.start_server(answer, "127.0.0.1", 0) as server:
        port = server.sockets[0].getsockname()[1]
        scan = Scan()
        options = {"port": f"tcp://127.0.0.1:{port}", "protocol": "vigor", "timeout": "1s"}
        await scan.start(options, None)
        async with asyncio.timeout(300):
            while scan.runs:
                await asyncio.sleep(0.01)
    shown = scan.document()
    assert [one["station"] for one in shown["found"]] == [0]
    assert "closed by the other side" in shown["error"]


# -- the way in --


async def entered(session: aiohttp.ClientSession, address: str) -> tuple[int, dict[str, Any]]:
    url, _, key = address.split()[1].partition("#")
    async with session.post(f"{url}api/enter", data=key) as reply:
        return reply.status, await reply.json()


async def test_the_address_works_once_and_nothing_works_without_its_token(tmp_path: Path) -> None:
    async with benched(tmp_path / "new.yaml") as (addresses, _), aiohttp.ClientSession() as client:
        first = await addresses.get()
        url = first.split()[1].partition("#")[0]

        async def state(**headers: str) -> int:
            async with client.get(f"{url}api/state", headers=headers) as reply:
                return reply.status

        assert await state() == 401
        status, found = await entered(client, first)
        assert status == 200
        own = {"Authorization": f"Bearer {found['token']}"}
        assert await state(**own) == 200
        assert (await entered(client, first))[0] == 403
        # A page of another site has no token, and with one it would still be refused.
        assert await state(**own, Origin="http://evil.example") == 403
        assert await state(**own, Host="evil.example") == 421
        assert await state(**own, **{"Sec-Fetch-Site": "cross-site"}) == 403
        for body in (b"", b"[]", b"{", b'{"names": 7}', b'{"device": {}, "tags": []}'):
            for step in ("stations", "tags", "look", "columns", "write", "scan"):
                async with client.post(f"{url}api/{step}", data=body, headers=own) as reply:
                    assert (reply.status, [*await reply.json()]) == (400, ["error"]), (step, body)
        # Who enters last has the bench.
        assert (await entered(client, await addresses.get()))[0] == 200
        assert await state(**own) == 401
    assert [*tmp_path.iterdir()] == []


# -- the page --


async def test_from_an_unknown_line_to_twenty_tags_on_zenoh_in_a_browser(tmp_path: Path) -> None:
    """The walk of an engineer, counted: a pasted list of names, and no key is needed."""
    path = tmp_path / "plant.yaml"
    async with (
        benched(path) as (addresses, api),
        browser(needs("chromium"), tmp_path / "profile") as tab,
    ):
        page = BenchPage(tab)
        await tab.look(1366, 900)
        began = time.monotonic()
        await page.named(await addresses.get())
        assert await tab.value("location.hash") == ""
        assert not path.exists()
        assert "tag-2: {address: D2, type: int16}" in await tab.value(shown("#difference"))
        await tab.until(f"/→\\n?.*[1-9]/s.test({shown('#loads')})")
        await page.click("#apply", f"{shown('#good')} === '20 of 20 values are good'")
        assert page.clicks == 5
        print(f"20 values after {time.monotonic() - began:.1f} s")  # shown by `pytest -rP`
        config = load(path)
        assert [tag.origin.word for tag in config.devices[0].tags] == ["simulated"] * 20

        def on_zenoh() -> list[str]:
            with connected(config, print) as client:
                return [row.tag for row in client.values("**")]

        assert len(await off_loop(on_zenoh)) == 20
        # The gateway has the line now: it reads the registers, also of a station without tags.
        for device, first in (("station-5", ""), ("station-1", "tag-0")):
            await tab.value(f"document.getElementById('device').value = '{device}'")
            await tab.value("document.getElementById('device').onchange()")
            await tab.until(f"/[0-9A-F]{{4}}/.test({shown('#registers td:nth-child(3)')})")
            await tab.until(f"{shown('#registers .known')} === '{first}'")
        # A tag that may be written, tried, and taken back.
        row = "#registers tr:nth-child(25) "
        await tab.value(f"document.querySelector('{row} .name').value = 'recipe'")
        await page.click(f"{row} [type=checkbox]", "true")
        await tab.value(f"document.querySelector('{row} [placeholder=greatest]').value = '40'")
        await page.click("#add-tags", f"{shown('#size')} === '21 tags on 1 line'")
        await page.click("#apply", "!document.getElementById('trial').hidden")
        send = "#values form button"
        await page.click("[aria-label='write station-1/recipe']", f"{shown(send)} !== ''")
        for value, outcome in (("400", "above the greatest value 40"), ("7", "acknowledged")):
            await tab.value(f"document.querySelector('#values form input').value = '{value}'")
            await page.click(send, f"{shown(send)}.includes('Confirm')")
            await page.click(send, f"{shown('#values .result')}.includes('{outcome}')")
        await page.click("#back", "document.getElementById('trial').hidden")
        assert len(load(path).devices[0].tags) == 20
        await tab.until(f"{shown('#good')} === '20 of 20 values are good'")
        await tab.until(f"{shown('#said')} === 'The file is as before.'")
        assert api.trial.said == "The file is as before."
        # Of a second line the page shows the first new station, not the one before.
        await tab.value("document.getElementById('protocol').value = 'modbus-rtu'")
        await page.click("#simulate", "!document.getElementById('stations-form').hidden")
        await tab.value(
            "[...document.querySelectorAll('#found li')].forEach("
            "(row, number) => { row.name.value = `drive-${number}`; });"
            " document.getElementById('line-name').value = 'hall-2'"
        )
        shown_device = "document.getElementById('device').value"
        await page.click("#stations-form .main", f"{shown_device} === 'drive-0'")
        assert tab.errors == []
