"""The page in a real browser: search, trends, alarms, writes, a lost connection, 50,000 tags."""

import json
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from urllib.parse import quote

import aiohttp
import pytest
from aiohttp import web

from gateway.contract.problems import Failure, Problem
from gateway.tags import AlarmRule, Level, Reason, WriteResult, WriteRule, bad, good
from tests.conftest import needs
from tests.e2e.processes import free_port
from tests.history.recorded import SPEED, history
from tests.northbound.plant import PlainDevice, PlainPlant, mixer, tag
from tests.web.browser import Tab, browser
from tests.web.serving import TOKEN, Client, serving

LIVE = 'document.body?.className === ""'
SECOND = 10**9
EVIL = "<img src=x onerror=alert(1)>"


@pytest.fixture
async def tab(tmp_path: Path) -> AsyncIterator[Tab]:
    async with browser(needs("chromium"), tmp_path / "profile") as found:
        await found.look(1366, 768)
        yield found
        assert found.errors == []


def text(selector: str) -> str:
    return f"(document.querySelector({json.dumps(selector)})?.innerText ?? '')"


def texts(selector: str) -> str:
    return f"[...document.querySelectorAll({json.dumps(selector)})].map((one) => one.innerText)"


async def opened(tab: Tab, client: Client, view: str = "overview") -> None:
    await tab.open(f"http://127.0.0.1:{client.port}/#{view}")
    await tab.until(LIVE)


def oven() -> PlainPlant:
    """An oven whose temperature is in alarm, with a setpoint."""
    plant = PlainPlant(
        PlainDevice(
            "oven",
            (
                tag(
                    "oven",
                    "temperature",
                    unit="°C",
                    scale=0.1,
                    alarm=AlarmRule({Level.HIGH: 80.0}, text="Oven too hot"),
                ),
                tag("oven", "setpoint", unit="°C", write=WriteRule(min=20, max=250)),
                tag("oven", "power", description=EVIL),
            ),
        )
    )
    hot = plant.now("oven/temperature", 91.5)
    plant.now("oven/setpoint", 85)
    plant.alarms.judge([hot])
    return plant


async def sign_in(tab: Tab, token: str = TOKEN) -> None:
    await tab.until('document.getElementById("sign-in").open')
    for name, value in (("token", token), ("by", "Ana")):
        await tab.value(f'document.getElementById("{name}").value = "{value}"')
    await tab.value('document.getElementById("token-form").requestSubmit()')
    await tab.until('!document.getElementById("sign-in").open')


async def test_values_are_shown_first_with_unit_decimals_limits_and_alarm(tab: Tab) -> None:
    async with serving(plant=oven()) as client:
        await opened(tab, client)
        await tab.until(f"{texts('.tile .value')}.length === 3 && !document.querySelector('.old')")
        assert await tab.value(texts(".tile .value")) == ["91.5 °C", "85 °C", "–"]
        [hot, _, unread] = await tab.value(texts(".tile"))
        assert "▲ 80" in hot
        assert "Oven too hot: too high (80)" in hot
        assert "bad: starting" in unread
        assert await tab.value('document.querySelectorAll(".tile.in-alarm.active").length') == 1
        assert EVIL in unread  # as text
        assert await tab.value('document.querySelector("#tiles img")') is None
        assert "hall" in await tab.value(text("#lines-short"))
        assert "oven is silent" in await tab.value(text("#wrong"))
        await tab.value('location.hash = "#lines"')
        await tab.until("document.querySelectorAll('.past rect.wrong').length === 1")
        assert "oven is silent: No byte came back" in await tab.value(
            "document.querySelector('.past title').textContent"
        )
        # Nobody can write without a file of tokens.
        assert await tab.value(
            '[...document.querySelectorAll("button")].every((one) => one.hidden'
            " || !/write|acknowledge/i.test(one.textContent) || !one.offsetParent)"
        )


async def test_one_search_finds_tags_and_devices(tab: Tab) -> None:
    async with serving(plant=mixer()) as client:
        await opened(tab, client)
        await tab.press("/")
        assert await tab.value("document.activeElement.id") == "find"
        await tab.type("guard mixer")  # words of the description and of the key
        await tab.until(f"{texts('#space .name')}.length === 1")
        assert "mixer/alarms/door" in await tab.value(text("#space .name"))
        await tab.value('document.getElementById("find").select()')
        await tab.type("ov")
        await tab.until(f"{text('#tags-title')}.startsWith('1 tag with')")
        assert (await tab.value(texts("#found-devices li")))[0].startswith("oven on hall silent")
        await tab.click("#found-devices a")
        await tab.until(f"{text('#tags-title')} === '1 tag of oven'")
        assert "check power" in await tab.value(text("#found-devices"))
        await tab.value('document.getElementById("find").focus()')
        await tab.press("Escape")
        await tab.until(f"{text('#tags-title')} === '4 tags'")


async def test_a_program_at_a_door_is_disconnected_after_a_second_click(
    tab: Tab, tokens: Path
) -> None:
    door = {"line": "hall", "listen": "0.0.0.0:1503", "protocol": "raw", "trouble": "", "most": 0.3}
    door |= {"share": 0.25, "turned_away": 0, "reads": []}
    program = {"address": "10.1.0.7", "since": 300.0, "requests": 0, "writes": 0, "refused": 0}
    button, listed = '[aria-label="disconnect the programs of ladder"]', text("#lines-list")
    async with serving(plant=oven(), tokens_file=tokens) as client:
        client.north.changed = {
            "doors/ladder": {**door, "programs": [{**program, "unanswered": 0}]}
        }
        client.north.endings[RELEASE] = Failure(Problem.BUSY, "this gateway is the standby")
        await opened(tab, client, "lines")
        await tab.until(f"{listed}.includes('door ladder, 25 % of the wire: 10.1.0.7')")
        await tab.click(button)
        await sign_in(tab)
        await tab.until(f"{text(button)} === 'Confirm: disconnect'")
        assert client.north.written == []
        await tab.click(button)
        await tab.until(f"{listed}.includes('door ladder: this gateway is the standby')")
        client.north.orders = released
        await tab.click(button)
        await tab.until(f"{listed}.includes('door ladder: disconnected')")
        assert client.north.written == [("ladder", RELEASE, "web alice")] * 2


RELEASE = b'{"do": "release"}'


async def released(_path: str, _data: bytes, _by: str | None) -> bytes:
    return b"{}"


async def test_an_alarm_is_acknowledged_and_a_value_written_after_one_sign_in(
    tab: Tab, tokens: Path
) -> None:
    async with serving(plant=oven(), tokens_file=tokens) as client:
        client.north.orders = client.plant.parts.alarms.order
        client.north.endings[b"90"] = WriteResult(90, 0, 0.03, verified=True)
        await opened(tab, client, "alarms")
        button = '#alarms-list button[aria-label="acknowledge oven/temperature"]'
        await tab.until(f"!!document.querySelector('{button}')")
        await tab.value(f"document.querySelector('{button}').focus()")
        await tab.press("Enter")
        await sign_in(tab)
        await tab.until(f"{text('#alarms-list')}.includes('acknowledged by Ana')")
        assert client.north.written[0][2] == "web alice"
        focused = "document.activeElement.getAttribute('aria-label')"
        assert await tab.value(focused) == "shelve oven/temperature"  # for the keyboard
        await tab.click('#alarms-list button[aria-label="shelve oven/temperature"]')
        await tab.until("document.activeElement.id === 'shelve-reason'")
        await tab.type("sensor broken")
        await tab.press("Enter")
        await tab.until(f"{text('#suppressed-list')}.includes('by Ana · sensor broken')")
        await tab.click('#suppressed-list button[aria-label="put oven/temperature back"]')
        await tab.until(f"{text('#alarms-list')}.includes('active since')")
        await tab.value('location.hash = "#tags"')
        await tab.click('#space button[aria-label="write oven/setpoint"]')
        await tab.until('document.activeElement.closest(".editor")')  # no token is asked for again
        shown = await tab.value(text(".editor"))
        assert "now 85 °C" in shown
        assert "at least 20 °C, at most 250 °C" in shown
        await tab.type("90")
        await tab.press("Enter")
        await tab.until(f"{text('.editor button.main')} === 'Confirm: 90 °C'")
        assert len(client.north.written) == 3  # not yet
        await tab.press("Enter")
        await tab.until(f"{text('.editor .result')} === '90 °C: acknowledged and read back'")
        assert client.north.written[3] == ("oven/setpoint", b"90", "web alice")
        await tab.value('document.querySelector(".editor input").value = "251"')
        for _ in range(2):
            await tab.click(".editor button.main")
        await tab.until(f"{text('.editor .result')}.startsWith('Not done: unknown-tag')")
        kept = "Object.keys(localStorage).length + document.cookie.length"
        assert await tab.value(kept) == 0  # the token is in the storage of this tab only


async def test_all_alarms_of_a_filter_are_acknowledged_at_once(tab: Tab, tokens: Path) -> None:
    rule = AlarmRule({Level.HIGH: 80.0}, text="Too hot")
    names = [f"{place}-{number:03}" for place in ("east", "west") for number in range(200)]
    plant = PlainPlant(PlainDevice("oven", tuple(tag("oven", name, alarm=rule) for name in names)))
    plant.alarms.judge([plant.now(f"oven/{name}", 90.0) for name in names])
    async with serving(plant=plant, tokens_file=tokens) as client:
        client.north.orders = client.plant.parts.alarms.order
        await opened(tab, client, "alarms")
        rows = "document.querySelectorAll('#alarms-list > .alarm').length"
        await tab.until(f"{rows} === 300 && {text('#alarms-list')}.endsWith('and 100 more')")
        await tab.click("#account")
        await sign_in(tab)
        await tab.until(f"{text('#acknowledge-all')} === 'Acknowledge all 400'")
        await tab.value("document.getElementById('alarm-filter').focus()")
        await tab.type("WEST hot")
        await tab.until(f"{rows} === 200 && {text('#acknowledge-all')} === 'Acknowledge all 200'")
        await tab.click("#acknowledge-all")
        await tab.until(f"{text('#acknowledge-result')} === '200 alarms acknowledged'")
        await tab.until(f"{text('#alarms-head')} === 'Alarms: 200 to acknowledge, 400 in all'")
        assert {key.partition("-")[0] for key, _, _ in client.north.written} == {"oven/west"}


async def test_a_wrong_token_is_said_and_not_kept(tab: Tab, tokens: Path) -> None:
    async with serving(plant=oven(), tokens_file=tokens) as client:
        await opened(tab, client)
        await tab.click("#account")
        await tab.value('document.getElementById("token").value = "wrong-wrong-wrong-wrong"')
        await tab.value('document.getElementById("by").value = "Ana"')
        await tab.value('document.getElementById("token-form").requestSubmit()')
        await tab.until(f"{text('#sign-in-why')}.includes('does not know this token')")
        assert await tab.value('sessionStorage.getItem("token")') is None
        await sign_in(tab)
        await tab.until(f"{text('#account')} === 'alice: sign out'")


async def test_a_token_that_is_withdrawn_is_asked_for_again(tab: Tab, tokens: Path) -> None:
    async with serving(plant=oven(), tokens_file=tokens) as client:
        client.north.endings[b"90"] = WriteResult(90, 0, 0.03, verified=True)
        await opened(tab, client, "tags")
        await tab.click('#space button[aria-label="write oven/setpoint"]')
        await sign_in(tab)
        await tab.until("document.activeElement.closest('.editor')")
        await tab.type("90")
        tokens.write_text(tokens.read_text().replace(TOKEN, TOKEN[::-1]))
        await tab.until(f"{text('#account')} === 'Sign in' && !sessionStorage.getItem('token')")
        await tab.press("Enter")
        await tab.until('document.getElementById("sign-in").open')
        assert client.north.written == []
        await sign_in(tab, TOKEN[::-1])
        await tab.until(f"{text('.editor button.main')} === 'Confirm: 90 °C'")
        await tab.click(".editor button.main")
        await tab.until(f"{text('.editor .result')} === '90 °C: acknowledged and read back'")


async def test_a_tab_that_is_not_seen_leaves_its_connection_to_others(tab: Tab) -> None:
    async with serving(plant=oven()) as client:
        await opened(tab, client)
        await tab.until(f"{texts('.tile .value')}[0] === '91.5 °C'")
        change = "document.dispatchEvent(new Event('visibilitychange'))"
        for hidden in ("true", "false"):
            how = f"{{value: {hidden}, configurable: true}}"
            await tab.value(f"Object.defineProperty(document, 'hidden', {how}); {change}")
            if hidden == "true":
                assert await tab.value('document.body.className === "stale"')
                client.plant.now("oven/temperature", 12.0)
        await tab.until(f"{LIVE} && {texts('.tile .value')}[0] === '12.0 °C'")


async def test_a_page_for_other_machines_asks_for_the_token(tab: Tab, tokens: Path) -> None:
    async with serving(plant=oven(), host="0.0.0.0", tokens_file=tokens) as client:
        await tab.open(f"http://127.0.0.1:{client.port}/")
        await sign_in(tab)
        await tab.until(f"{LIVE} && {texts('.tile .value')}[0] === '91.5 °C'")


async def test_nothing_is_live_without_the_gateway_and_all_is_when_it_is_back(tab: Tab) -> None:
    port, plant = free_port(), oven()
    async with serving(plant=plant, port=port) as client:
        await opened(tab, client)
        await tab.until(f"{texts('.tile .value')}[0] === '91.5 °C'")
    await tab.until('document.body.className === "stale"')
    assert await tab.value(texts(".tile .quality")) == ["not live"] * 3
    assert "may be old" in await tab.value(text("#lost"))
    struck = 'getComputedStyle(document.querySelector(".tile .value")).textDecorationLine'
    assert await tab.value(struck) == "line-through"
    plant.now("oven/temperature", 12.0)
    async with serving(plant=plant, port=port):
        await tab.until(f"{LIVE} && {texts('.tile .value')}[0] === '12.0 °C'")
        assert await tab.value('document.getElementById("lost").hidden')


async def test_a_trend_has_a_cursor_a_zoom_and_bands_of_bad_quality(
    tab: Tab, tmp_path: Path
) -> None:
    now = time.time_ns()
    plant = PlainPlant(PlainDevice(SPEED.device, (SPEED,)))
    with history(tmp_path / "history.db") as historian:
        at = [now - second * SECOND for second in range(600, 0, -1)]
        historian.record(
            [
                bad(SPEED, Reason.NO_REPLY, when)
                if 200 <= place < 300
                else good(SPEED, place, when)
                for place, when in enumerate(at)
            ]
        )
        plant.now(SPEED.key, 600)
        async with serving(history=historian, plant=plant) as client:
            await opened(tab, client)
            await tab.until("document.querySelector('[data-view=trend]').hash.length > 6")
            await tab.click("[data-view=trend]")  # begins with tags of the overview
            await tab.until(f"location.hash === '#trend?tags={quote(SPEED.key, safe='')}'")
            await opened(tab, client, f"trend?tags={SPEED.key}&span=600")
            await tab.until("!!document.querySelector('#chart .u-over')")
            span = "(([, a, b]) => b - a)(location.hash.match(/from=([\\d.]+)&to=([\\d.]+)/) ?? [])"
            assert await tab.value(f"isNaN({span})")
            await tab.drag("#chart .u-over", 0.4, 0.45)  # where nothing was known
            await tab.until(f"{span} > 20 && {span} < 40")
            await tab.until(f"{text('#pens .at')}.includes('no value: no-reply')")
            await tab.click("#wider")
            await tab.until(f"{span} > 40 && {span} < 80")
            await tab.click('#spans button[value="300"]')
            await tab.until("location.hash.endsWith('&span=300')")
            await tab.call("Input.dispatchMouseEvent", type="mouseMoved", x=5, y=5)
            await tab.until(
                "document.querySelector('#spans [aria-pressed=true]').textContent === '5 min' && "
                "document.getElementById('trend-text').textContent.includes('(now)')"
            )
            assert await tab.value(text("#pens .value")) == "600"


async def test_two_fingers_zoom_a_trend_and_one_moves_it(tab: Tab, tmp_path: Path) -> None:
    now = time.time_ns()
    plant = PlainPlant(PlainDevice(SPEED.device, (SPEED,)))
    with history(tmp_path / "history.db") as historian:
        historian.record([good(SPEED, one, now - (600 - one) * SECOND) for one in range(600)])
        async with serving(history=historian, plant=plant) as client:
            await tab.look(390, 844)
            await opened(tab, client, f"trend?tags={SPEED.key}&span=600")
            await tab.until("!!document.querySelector('#chart .u-over')")
            ends = "(location.hash.match(/from=([\\d.]+)&to=([\\d.]+)/) ?? []).slice(1).map(Number)"
            await tab.touch("#chart .u-over", (0.4, 0.2), (0.6, 0.8))
            await tab.until(f"{ends}.length === 2")
            [from_, to] = await tab.value(ends)
            assert 180 < to - from_ < 220  # a third, around the same middle
            assert now / 1e9 - 420 < from_
            await tab.touch("#chart .u-over", (0.3, 0.8))
            await tab.until(f"{ends}[0] < {from_ - 60}")
            [earlier, until] = await tab.value(ends)
            assert abs((until - earlier) - (to - from_)) < 1
            assert 80 < from_ - earlier < 120  # half of the width
            await tab.touch("#chart .u-over", (0.1, 0.45), (0.9, 0.55))
            await tab.until("/span=\\d+$/.test(location.hash)")  # it reaches now again


async def test_fifty_thousand_tags_scroll_in_a_few_rows(tab: Tab) -> None:
    devices = [
        PlainDevice(f"d{number}", tuple(tag(f"d{number}", f"t{one}") for one in range(500)))
        for number in range(100)
    ]
    async with serving(plant=PlainPlant(*devices)) as client:
        await opened(tab, client, "tags")
        await tab.until(f"{text('#tags-title')} === '50,000 tags'")
        names = texts("#space .name")
        await tab.until(f"{names}[0] === 'd0/t0'")
        await tab.value("document.querySelector('#space .row a').focus()")
        for place, name in (("1e9", "d99/t499"), ("0", "d0/t0"), ("25000 * 60", "d5")):
            await tab.value(f'document.getElementById("window").scrollTop = {place}')
            await tab.until(f"{names}.some((one) => one.startsWith('{name}'))")
            assert await tab.value('document.querySelectorAll("#space .row").length') < 60
            assert await tab.value('!!document.activeElement.closest("#window")')
        await tab.value('document.getElementById("find").focus()')
        await tab.type("d42/t4")
        await tab.until(f"{text('#tags-title')}.startsWith('111 tags')")
        await tab.until(f"{names}[0] === 'd42/t4'")


OUTSIDE = """
[...document.querySelectorAll("main *, header *, nav *")].filter((one) => one.checkVisibility()
  && !one.closest(".hidden, svg, .uplot, .skip")
  && one.getBoundingClientRect().right > innerWidth + 1)
  .map((one) => one.outerHTML.slice(0, 200))
"""
CUT = """
[...document.querySelectorAll(".value, .name, .tile, .alarm, nav a, .count")].filter((one) =>
  one.checkVisibility() && one.scrollWidth > one.clientWidth + 1
  && getComputedStyle(one).display !== "inline")
  .map((one) => one.outerHTML.slice(0, 200))
"""


async def test_hostile_texts_hide_nothing_and_turn_no_digits(tab: Tab) -> None:
    long, turned = "x" * 10_000, "\u202eabc\u2067"
    hot = AlarmRule({Level.HIGH: 5.0}, text=long)
    tags = [
        tag("oven", "long", unit=long, description=long, alarm=hot, write=WriteRule()),
        tag("oven", "turned", unit=turned, description=turned, alarm=AlarmRule({Level.HIGH: 5.0})),
        tag("oven", "n" * 180, description=EVIL, unit=EVIL, write=WriteRule()),
    ]
    plant = PlainPlant(PlainDevice("oven", tuple(tags)))
    plant.alarms.judge([plant.now(one.key, 91.5) for one in tags])
    async with serving(plant=plant) as client:
        await tab.look(390, 844)
        for view in ("overview", "tags", "alarms", "trend?tags=oven/long,oven/turned"):
            await opened(tab, client, view)
            shown = ".view:not([hidden]) :is(.tile, .alarm, .pen, #space .row)"
            await tab.until(f"document.querySelectorAll('{shown}').length > 1")
            heights = f"[...document.querySelectorAll('{shown}')].map((one) => one.offsetHeight)"
            assert max(await tab.value(heights)) < 400, view
            assert await tab.value("document.documentElement.scrollWidth") <= 390
            assert await tab.value("document.querySelectorAll('main img').length") == 0
            text_shown = await tab.value("document.body.textContent")
            assert not {"\u202e", "\u2067"} & {*text_shown}


@pytest.mark.parametrize(
    ("width", "height", "language"),
    [(390, 844, "de"), (1920, 1080, "en")],  # German has the longest words
)
async def test_nothing_is_cut_off(
    tab: Tab, tokens: Path, width: int, height: int, language: str
) -> None:
    plant = oven()
    async with serving(plant=plant, tokens_file=tokens, language=language) as client:
        await tab.look(width, height, dark=width < 600)
        for view in ("overview", "tags", "alarms", "lines", "trend?tags=oven/temperature"):
            await opened(tab, client, view)
            await tab.until(
                "document.querySelectorAll('.view:not([hidden]) li, .row b').length > 0"
            )
            assert await tab.value("document.documentElement.scrollWidth") <= width
            assert (view, await tab.value(OUTSIDE)) == (view, [])
            assert (view, await tab.value(CUT)) == (view, [])


async def test_the_page_works_behind_a_proxy_at_a_path_of_its_own(tab: Tab, tokens: Path) -> None:
    async with serving(plant=oven(), tokens_file=tokens) as client, proxy(client, "/hall") as port:
        client.north.orders = client.plant.parts.alarms.order
        await tab.open(f"http://127.0.0.1:{port}/hall/#alarms")
        await tab.until(LIVE)
        await tab.click('#alarms-list button[aria-label="acknowledge oven/temperature"]')
        await sign_in(tab)
        await tab.until(f"{text('#alarms-list')}.includes('acknowledged by Ana')")
        await tab.value('location.hash = "#trend?tags=oven/temperature"')
        await tab.until("!!document.querySelector('#chart .u-over')")  # uplot.js was found


@asynccontextmanager
async def proxy(client: Client, path: str) -> AsyncIterator[int]:
    """A reverse proxy that keeps the Host; yields its port."""
    async with aiohttp.ClientSession(auto_decompress=False) as session:

        async def passed(request: web.Request) -> web.StreamResponse:
            url = f"http://127.0.0.1:{client.port}/{request.match_info['rest']}"
            asked = session.request(
                request.method,
                url,
                params=request.query,
                headers=request.headers,
                data=await request.read(),
            )
            async with asked as reply:
                response = web.StreamResponse(status=reply.status, headers=reply.headers)
                await response.prepare(request)
                async for piece in reply.content.iter_any():
                    await response.write(piece)
            return response

        app = web.Application()
        app.router.add_route("*", f"{path}/{{rest:.*}}", passed)
        runner = web.AppRunner(app, shutdown_timeout=0.1)
        await runner.setup()
        try:
            await web.TCPSite(runner, "127.0.0.1", port := free_port()).start()
            yield port
        finally:
            await runner.cleanup()


async def test_a_small_page_of_another_place_shows_and_writes(tab: Tab, tokens: Path) -> None:
    """examples/hmi.html, from a server of its own; at an origin that is not listed it is blind."""
    app = web.Application()
    app.router.add_static("/", Path(__file__).parents[2] / "examples")
    runner, port = web.AppRunner(app), free_port()
    await runner.setup()
    await web.TCPSite(runner, "127.0.0.1", port).start()
    speed = 'document.getElementById("mixer/speed").textContent'
    origins = [f"http://127.0.0.1:{port}"]
    async with serving(tokens_file=tokens, origins=origins) as client:
        client.plant.now("mixer/speed", 57.7)
        client.north.endings[b"7"] = WriteResult(7, 0, 0.03, verified=False)
        page = f"hmi.html?gateway=http://127.0.0.1:{client.port}"
        await tab.open(f"http://127.0.0.1:{port}/{page}")
        await tab.until(f'{speed} === "57.7"')
        client.plant.samples["mixer/speed"] = bad(
            client.plant.samples["mixer/speed"].tag, Reason.NO_REPLY, time.time_ns()
        )
        await tab.until(f'{speed}.startsWith("bad: no-reply")')
        for token, told in (("wrong", "not written: a token is needed"), (TOKEN, "acknowledged")):
            form = f'document.forms[0].value.value = 7; document.forms[0].token.value = "{token}"'
            await tab.value(f"{form}; document.forms[0].requestSubmit()")
            await tab.until(f'document.forms[0].told.value.startsWith("{told}")')
        assert client.north.written == [("mixer/recipe", b"7", "web alice")]
        await tab.open(f"http://localhost:{port}/{page}")
        await tab.until(f'{speed} === "not live"')
        tab.errors.clear()  # the browser says that it refused
        await tab.open(f"http://127.0.0.1:{port}/{page}")
        await tab.until(f'{speed}.startsWith("bad")')
    await tab.until(f'{speed} === "not live"')
    tab.errors.clear()
    await runner.cleanup()
