"""The languages of the page: complete catalogues, the choice, and no sentence outside them."""

import ast
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from gateway.contract import languages
from gateway.contract.faults import ALARM_STATES
from gateway.contract.languages import LANGUAGES, PLACE, Catalogue, catalogue, matching, translator
from gateway.contract.problems import Problem
from gateway.engine.device.health import diagnosis
from gateway.errors import Evidence, Garbled, NoReply
from gateway.protocols.computer_link import NO_REPLY_CAUSES
from gateway.tags import Priority, Reason, WriteResult
from gateway.transport import os_errors
from tests.conftest import needs
from tests.web.browser import browser
from tests.web.serving import DOCUMENTS, calling, serving, transfer
from tests.web.test_fleet import reports
from tests.web.test_page import opened, oven, sign_in, text

GATEWAY = Path(languages.__file__).parents[2]
ASSETS = {
    "page": (GATEWAY / "parts/web/assets", "page.html"),
    "bench": (GATEWAY / "cli/bench/assets", "bench.html"),
}
FLEET = GATEWAY / "parts/web/fleet/assets"
TRANSLATED = [one for one in LANGUAGES if one != "en"]
PARTS = ("page", "bench", "sentences")
# Texts of the page in its scripts: t("…"), and both of several(…, "…", "…").
_TEXT = re.compile(r'\bt\("((?:[^"\\]|\\.)*)"')
_TWO = re.compile(r'\bseveral\([^"]*"([^"]*)", "([^"]*)"')


def shown(part: str) -> set[str]:
    """The texts of a page, as its files have them."""
    folder, document = ASSETS[part]
    found = set[str]()
    files = {*folder.glob("*.js"), ASSETS["page"][0] / "language.js"}
    for file in files | ({*FLEET.glob("*.js")} if part == "page" else set()):
        if file.name != "uplot.js":
            source = file.read_text()
            found |= {*_TEXT.findall(source)} | {one for two in _TWO.findall(source) for one in two}
    html = (folder / document).read_text()
    body = re.sub(r"<noscript>.*?</noscript>", "", html[html.index("<body") :], flags=re.DOTALL)
    texts = re.findall(r'(?:aria-label|placeholder)="([^"]+)"', body)
    found |= {one for one in texts if re.search("[A-Za-z]{3}", one)}
    texts = re.findall(r">([^<>]+)<", body)
    return found | {one.strip() for one in texts if re.search("[a-z]", one)}


def strings(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


@pytest.mark.parametrize("part", ["page", "bench"])
def test_a_catalogue_has_each_text_of_the_page_and_no_other(part: str) -> None:
    for language in TRANSLATED:
        assert (language, shown(part) ^ {*catalogue(language)[part]}) == (language, set())


def test_all_catalogues_have_the_same_keys_and_places() -> None:
    for part in PARTS:
        keys = [*catalogue("de")[part]]
        for language in TRANSLATED:
            found = catalogue(language)[part]
            assert [*found] == keys
            for words, translated in found.items():
                assert translated.strip(), words
                assert {*PLACE.findall(words)} == {*PLACE.findall(translated)}, (language, words)


def test_each_sentence_of_a_catalogue_is_one_of_the_gateway() -> None:
    trees = [ast.parse(file.read_text()) for file in GATEWAY.rglob("*.py")]
    known = "\n".join(one for tree in trees for one in strings(tree))
    known += "\n".join(file.read_text() for file in ASSETS["page"][0].glob("*.js"))
    known += diagnosis(NoReply(""), NO_REPLY_CAUSES).text
    for words in catalogue("de")["sentences"]:
        for piece in PLACE.split(words)[::2]:
            for one in piece.split(": "):
                assert one.strip(" .,;:()") in known, words


def test_each_sentence_about_faults_is_in_the_catalogues() -> None:
    known = "\n".join(PLACE.sub("\n", words) for words in catalogue("de")["sentences"])
    for name in ("faults", "line_faults"):
        tree = ast.parse((GATEWAY / f"contract/{name}.py").read_text())
        documented = [one for one in ast.walk(tree) if isinstance(one, DOCUMENTED)]
        about = {ast.get_docstring(one, clean=False) for one in documented}
        for one in {*strings(tree)} - about:
            if re.search("[a-z]{2} [a-z]", one):
                assert one.removeprefix("history: ").strip(" .,;:()") in known


DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef)


def test_words_and_diagnoses_of_the_gateway_are_translated() -> None:
    words = [*Reason, *Problem, *Priority, *os_errors._SENTENCES.values(), *ALARM_STATES]
    words = [one for one in words if one not in NOT_SHOWN]
    words += [diagnosis(NoReply("no reply"), "").text]
    words += [
        diagnosis(Garbled("7 bytes", evidence=one), "").text
        for one in Evidence
        if one is not Evidence.SILENCE
    ]
    for language in TRANSLATED:
        for one in words:
            assert translator(language)(one) != one, (language, one)


# A page does not show them: `normal` alarms, groups of writes, queries of history.
NOT_SHOWN = {"normal", "returned", "out_of_service", "bad-query", "damaged", "no-history"}


@pytest.mark.parametrize(
    ("accepted", "language"),
    [
        ("de-AT,de;q=0.9,en;q=0.8", "de"),
        ("en-GB,en;q=0.9,de;q=0.8", "en"),
        ("zh-TW,zh;q=0.9,en;q=0.8", "zh-TW"),
        ("zh-Hant-HK,en;q=0.8", "zh-TW"),
        ("zh,en;q=0.8", "zh-CN"),
        ("fr,ko-KR;q=0.7,en;q=0.3", "ko"),
        ("de;q=0,ko;q=0.001", "ko"),
        ("fr", "en"),
        ("de;q=9,ko", "de"),  # a wrong weight is none
        ("", "en"),
        (",;q=;=,*", "en"),
    ],
)
def test_the_language_is_the_first_one_that_the_browser_accepts(
    accepted: str, language: str
) -> None:
    assert matching(accepted) == language


async def test_a_choice_comes_before_the_file_and_the_file_before_the_browser() -> None:
    async def code(client: Any, **headers: str) -> str:
        answer = await client.ask("/catalogue.js", **headers)
        assert "Cookie" in answer.headers["Vary"]
        return str(json.loads(answer.body.removeprefix(b"export default ").rstrip(b";"))["code"])

    async with serving(language="ko") as client:
        assert await code(client, Accept_Language="de") == "ko"
        assert await code(client, Accept_Language="de", Cookie="language=zh-TW") == "zh-TW"
        assert await code(client, Accept_Language="de", Cookie="language=../../x") == "ko"
    async with serving() as client:
        assert await code(client, Accept_Language="de") == "de"
        assert await code(client) == "en"


async def test_the_whole_page_is_small_over_the_wire() -> None:
    files = {one.name for one in ASSETS["page"][0].iterdir()} - {"page.html"} | {"", "catalogue.js"}
    async with serving() as client:
        for language in LANGUAGES:
            answers = [
                await client.ask(f"/{one}", Accept_Encoding="gzip", Accept_Language=language)
                for one in files
            ]
            assert {one.status for one in answers} == {200}
            assert sum(len(one.body) for one in answers) < 120_000  # measured: 77,000


def pseudo(language: languages.Language) -> Catalogue:
    """The catalogue of a language without Latin letters, also of its places."""
    found = catalogue(language)
    return {
        "name": found["name"],
        **{part: {words: _without_latin(words) for words in found[part]} for part in PARTS},
    }


def _without_latin(words: str) -> str:
    pieces = re.split(r"(\{\w+\})", words)
    return "".join(one if at % 2 else re.sub("[A-Za-z]", "ж", one) for at, one in enumerate(pieces))


# Latin words on a page that are no data of this plant: none but those of the wire and names.
LATIN = r"""
(() => {
  const seen = (one) => one && one.checkVisibility({ visibilityProperty: true })
    && !one.closest("script, style, noscript, #language, .uplot");
  const texts = [];
  const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walk.nextNode())
    if (seen(walk.currentNode.parentElement)) texts.push(walk.currentNode.data);
  for (const one of document.querySelectorAll("[title], [aria-label], [placeholder]"))
    for (const name of ["title", "aria-label", "placeholder"])
      if (seen(one)) texts.push(one.getAttribute(name) ?? "");
  for (const one of document.querySelectorAll("svg title")) texts.push(one.textContent);
  return texts.filter((one) => /[A-Za-z]{2}/.test(one.replace(DATA, "")));
})()
"""
DATA = [
    "No byte came back: check power, wiring and station number",  # of these documents only
    *("oven", "mixer", "temperature", "setpoint", "power", "Oven too hot", "hall", "demo"),
    "ladder",
    *("speed", "pumps", "plc-gateway", "Ana", "alice", "sensor broken", "int16", "bool", "BUSY"),
    *("<img src=x onerror=alert(1)>", "D0", "tcp/10.0.0.1:7447", "7 bytes", "raw"),
    *("works/north/", "one", "two", "three"),
    *("modem:/dev/ttyS0", "/dev/ttyS0", "float64", "D100"),
]
NO_BYTE = diagnosis(NoReply("no reply"), "").text
DOOR = {"line": "hall", "listen": "0.0.0.0:1503", "protocol": "raw", "trouble": "", "most": 0.3}
PROGRAM = {"address": "10.1.0.7", "since": 300.0, "requests": 0, "writes": 0, "refused": 0}


def wrong() -> dict[str, Any]:
    """Documents with much that is wrong."""
    lately = {"requests": 200, "failed": {"silence": 150}}
    device = {**DOCUMENTS["devices/oven"], "lately": lately, "diagnosis": NO_BYTE}
    garbled = diagnosis(Garbled("7 bytes"), "").text
    return {
        "devices/oven": {**device, "silent_for": 4000.0, "silences": 2},
        "devices/mixer": {**device, "silent_for": 40.0},
        "lines/pumps": {**calling(), "open": False, "trouble": "/dev/ttyS0: no such port"},
        "lines/hall": {**DOCUMENTS["lines/hall"], "devices": {"mixer": "up", "oven": "silent"}},
        "devices/hall-2": {**DOCUMENTS["devices/mixer"], "diagnosis": garbled},
        "transfers/1": transfer("refused", why="251 is above the greatest value 250"),
        "zenoh": {**dict.fromkeys(("published",), 7), "to": [], "connect": ["tcp/10.0.0.1:7447"]},
        "doors/ladder": {
            **DOOR,
            "share": 0.25,
            "turned_away": 0,
            "reads": [],
            "programs": [{**PROGRAM, "unanswered": 0}],
        },
    }


def gateways() -> Iterator[tuple[str, bytes, float]]:
    """Reports of gateways: a good one, one with faults, an old one."""
    sick: dict[str, object] = {"fault": NO_BYTE, "faults": {"1": 2}}
    return reports(
        one={}, two=sick, three={"version": "1.0.0", "group": "hall", "stand": "standby"}
    )


async def test_the_page_has_no_sentence_outside_its_catalogue(
    tmp_path: Path, tokens: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gateway.parts.web.languages.catalogue", pseudo)
    data = "new RegExp(" + json.dumps("|".join(map(re.escape, DATA))) + ', "g")'
    latin = LATIN.replace("DATA", data)
    async with (
        browser(needs("chromium"), tmp_path / "profile") as tab,
        serving(plant=oven(), tokens_file=tokens, language="de", fleet=True) as client,
    ):
        await tab.look(1366, 768)
        client.north.changed = wrong()
        client.north.fleet = gateways
        client.north.orders = client.plant.parts.alarms.order
        client.north.endings[b"90"] = WriteResult(90, 0, 0.03, verified=True)
        views = ("overview", "tags", "alarms", "lines", "fleet", "trend?tags=oven/temperature")
        for view in views:
            await opened(tab, client, view)
            await tab.until("!!document.querySelector('.view:not([hidden]) :is(li, .row b)')")
            await tab.until("!/[a-z]{3}/.test(document.querySelector('#live').innerText)")
            assert (view, await tab.value(latin)) == (view, [])
        await tab.value('location.hash = "#lines"')
        await tab.value("for (const one of document.querySelectorAll('details')) one.open = true")
        await tab.click(".card.line button")  # the wire
        await tab.until("!!document.querySelector('.wire-sum').innerText")
        assert await tab.value(latin) == []
        await tab.value('location.hash = "#alarms"')
        await tab.click("#alarms-list .alarm button")
        await sign_in(tab)
        await tab.until(f"{text('#alarms-list')}.includes('Ana')")
        await tab.click("#alarms-list .alarm .bar button:last-child")
        await tab.until("document.getElementById('shelve').open")
        assert await tab.value(latin) == []
        await tab.type("sensor broken")
        await tab.press("Enter")
        await tab.until(f"{text('#suppressed-list')}.includes('sensor broken')")
        assert await tab.value(latin) == []
        await tab.value('location.hash = "#tags"')
        await tab.click("#space button.write")
        await tab.until("!!document.querySelector('.editor')")
        await tab.type("90")
        for _ in range(2):
            await tab.press("Enter")
        await tab.until(f"!!{text('.editor .result')}")
        assert await tab.value(latin) == []
        assert tab.errors == []


NOISE = f"{diagnosis(Garbled('7 bytes'), '').text} (for 12 s): a, b, c"
SENTENCES = [
    *("line hall is down: /dev/ttyUSB0: no such port (for 3 h 20 min, 2 times in 24 h)", NO_BYTE),
    "line hall: all 3 devices are silent, no frame to 74% of the last 200 requests: " + NOISE,
    f"oven is silent: {NO_BYTE} (for 5 min)",
    "transfer 1 (a/b to c/d) is refused: 251 is above the greatest value 250",
    *("all is well", "a: b: c", "no-reply", "x" * 2000, ""),
]


async def test_the_page_translates_as_the_gateway_does_and_keeps_a_choice(tmp_path: Path) -> None:
    async with browser(needs("chromium"), tmp_path / "profile") as tab, serving() as client:
        await tab.call("Network.setUserAgentOverride", userAgent="x", acceptLanguage="ko")
        await opened(tab, client)
        assert await tab.value("document.documentElement.lang") == "ko"
        assert "알람" in await tab.value(text("nav"))
        await tab.leave(
            "const list = document.getElementById('language'); list.value = 'de';"
            "list.dispatchEvent(new Event('change'))"
        )
        await tab.until(f"{text('nav')}.includes('Alarme')")
        sentences = json.dumps(SENTENCES)
        translated = await tab.value(
            f"import('/language.js').then(({{ said }}) => {sentences}.map(said))"
        )
        assert translated == [translator("de")(one) for one in SENTENCES]
        assert translated[0].startswith("Leitung hall unterbrochen: /dev/ttyUSB0: kein solcher")
        await opened(tab, client, "tags")
        assert await tab.value("document.documentElement.lang") == "de"


def test_an_unknown_sentence_stays_as_it_is() -> None:
    for language in LANGUAGES:
        assert translator(language)("the tank is full of {water}") == "the tank is full of {water}"
