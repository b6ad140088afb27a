"""The HTTP side of a real gateway: metrics, alert rules, the API, and the page in a browser."""

import json
import re
import signal
import socket
import subprocess
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml

from gateway.parts.web.connections import MOST_CONNECTIONS
from tests.conftest import needs
from tests.e2e.processes import (
    ROOT,
    Program,
    free_port,
    started,
    until,
    vigor_line,
    write_config,
)
from tests.web.browser import Tab, browser
from tests.web.serving import TOKEN, calling, serving, transfer
from tests.zenoh_peer import free_endpoint

EXAMPLES = ROOT / "examples" / "prometheus"
TAGS = {
    "speed": {"address": "D10", "unit": "rpm", "history": True},
    "level": {"address": "D11", "type": "uint32"},
    "recipe": {"address": "D500", "write": {"min": 1, "max": 40, "verify": True}},
    "steps": {"address": "D510", "type": "uint16[40]", "history": True, "write": True},
}


class Page(NamedTuple):
    """A gateway with one line of two stations, of which one is silent."""

    program: Program
    port: int

    def ask(self, path: str, body: bytes | None = None, **headers: str) -> tuple[int, Any]:
        """Returns status and body. Underscores of the names of headers stand for hyphens."""
        fields = {name.replace("_", "-"): value for name, value in headers.items()}
        url = f"http://127.0.0.1:{self.port}{path}"
        request = urllib.request.Request(url, body, fields)
        try:
            with urllib.request.urlopen(request, timeout=300) as reply:  # noqa: S310  (our own address)
                found = reply.status, reply.headers, reply.read()
        except urllib.error.HTTPError as error:
            with error:
                found = error.code, error.headers, error.read()
        status, kind, text = found[0], found[1]["Content-Type"], found[2].decode()
        return status, json.loads(text) if kind.startswith("application/json") else text


@pytest.fixture(scope="module")
def pages() -> Iterator[tuple[ExitStack, list[Page]]]:
    with ExitStack() as stack:
        yield stack, []


@pytest.fixture
def page(pages: tuple[ExitStack, list[Page]], tmp_path_factory: pytest.TempPathFactory) -> Page:
    """The gateway of the test before, if it still runs."""
    stack, known = pages
    if not known or not known[-1].program.running:
        known.append(begun(stack, tmp_path_factory.mktemp("web")))
    return known[-1]


def begun(stack: ExitStack, folder: Path) -> Page:
    port, tokens = free_port(), folder / "tokens.txt"
    tokens.write_text(f"alice:{TOKEN}\n")
    tokens.chmod(0o600)
    silent = vigor_line(str(folder / "no-port"), {"level": {"address": "D10"}})
    silent["devices"] = {"oven": silent["devices"]["mixer"]}
    config = write_config(
        folder / "config.yaml",
        free_endpoint(),
        {"hall": vigor_line("simulator", TAGS), "yard": silent},
        history={"path": "history.db"},
        web={"listen": f"127.0.0.1:{port}", "tokens_file": "tokens.txt"},
        transfers=[{"from": "oven/level", "to": "mixer/recipe"}],  # its line is down
    )
    page = Page(stack.enter_context(started(config)), port)
    page.program.says("device online")
    until(lambda: "last_good_seconds{" in page.ask("/metrics")[1], "the mixer was read")
    return page


def test_promtool_finds_nothing_wrong_with_the_metrics(page: Page) -> None:
    promtool = needs("promtool")
    status, text = page.ask("/metrics")
    assert status == 200
    ran(promtool, "check", "metrics", said=text)
    assert re.search(r'^plc_gateway_line_up{line="hall"} 1.0$', text, re.MULTILINE)
    assert re.search(r'^plc_gateway_line_up{line="yard"} 0.0$', text, re.MULTILINE)
    assert 'plc_gateway_device_last_good_seconds{device="mixer",line="hall"} 0.' in text
    assert "plc_gateway_history_ok 1.0" in text


def test_rules_and_dashboard_use_only_metrics_of_the_gateway(page: Page) -> None:
    names = set(re.findall(r"^# TYPE (\S+)", page.ask("/metrics")[1], re.MULTILINE))
    names |= {f"{name}_bucket" for name in names if name.endswith("_seconds")}
    dashboard = json.loads((EXAMPLES / "grafana-dashboard.json").read_text())
    asked = [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]
    rules = yaml.safe_load((EXAMPLES / "alerts.yml").read_text())
    asked += [rule["expr"] for group in rules["groups"] for rule in group["rules"]]
    used = {name for text in asked for name in re.findall(r"\b(?:plc_gateway|process)_\w+", text)}
    assert len(used) >= 20
    assert used - names == set()


def test_each_alert_fires_for_its_fault_and_none_for_a_healthy_plant() -> None:
    promtool = needs("promtool")
    ran(promtool, "check", "config", EXAMPLES / "prometheus.yml")
    ran(promtool, "test", "rules", EXAMPLES / "alerts_test.yml")


def ran(*command: str | Path, said: str = "") -> None:
    done = subprocess.run(command, input=said, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_probes_and_foreign_names(page: Page) -> None:
    assert page.ask("/healthz") == (200, "ok\n")
    assert page.ask("/readyz") == (200, "ready\n")
    assert page.ask("/metrics", Host="evil.example")[0] == 421
    assert page.ask("/metrics", Origin="http://evil.example")[0] == 403


def test_a_write_over_http_is_done_and_recorded_with_its_name(page: Page) -> None:
    kind = {"Content_Type": "application/json"}
    address = "/api/write?tag=mixer/recipe"
    assert page.ask(address, b"7", **kind)[0] == 401
    token = {**kind, "Authorization": f"Bearer {TOKEN}"}
    assert page.ask(address, b"41", **token)[0] == 400
    status, found = page.ask(address, b"7", **token)
    assert (status, found["value"], found["verified"]) == (200, 7, True)
    page.program.says("tag written", "web alice", "mixer/recipe")
    written = re.compile(r'writes_total{outcome="written"} [1-9]')
    until(lambda: bool(written.search(page.ask("/metrics")[1])), "the write is counted")


def test_connections_that_send_nothing_close_the_page_to_nobody(page: Page) -> None:
    with ExitStack() as stack:
        idle = [
            stack.enter_context(socket.create_connection(("127.0.0.1", page.port), timeout=300))
            for _ in range(MOST_CONNECTIONS + 50)
        ]
        assert [page.ask(path)[0] for path in ("/healthz", "/readyz", "/metrics", "/")] == 4 * [200]
        assert [one.recv(1) for one in idle[:50]] == 50 * [b""]  # those were the idlest
    assert page.program.running


LIVE = 'document.body?.className === ""'
LONG_AGO = "2026-01-02T03:04:05.000000Z"


def texts(selector: str) -> str:
    lines = "one.innerText.replace(/\\n+/g, '\\n')"
    return f"[...document.querySelectorAll('{selector}')].map((one) => {lines})"


SIGN_IN = f"""
for (const [id, value] of Object.entries({{token: "{TOKEN}", by: "Ana"}}))
  document.getElementById(id).value = value;
document.getElementById("token-form").requestSubmit()
"""
STEPS = json.dumps([60000 + number for number in range(40)])


async def test_the_page_is_live_and_turns_grey_at_once_when_the_gateway_ends(
    page: Page, tmp_path: Path
) -> None:
    async with browser(needs("chromium"), tmp_path) as tab:
        await tab.open(f"http://127.0.0.1:{page.port}/#lines")
        await tab.until(f"{LIVE} && {texts('#wrong li')}.join().includes('line yard is down')")
        stale = "stale\\nnever carried\\noven/level is bad: line-down ("
        await tab.until(f"{texts('#transfers li')}.join().includes('{stale}')")
        await tab.click('button[aria-label="wire of hall"]')
        await tab.until(
            "/^[1-9]\\d* exchanges/.test(document.querySelector('.wire-sum')?.innerText)"
        )
        await tab.value('location.hash = "#alarms"')
        await tab.click('button[aria-label="acknowledge line:yard"]')
        await tab.until('document.getElementById("sign-in").open')
        await tab.value(SIGN_IN)
        await tab.until(f"{texts('#alarms-list li')}.join().includes('acknowledged by Ana')")
        await tab.value('location.hash = "#tags?device=mixer"')
        await tab.until(
            f"{texts('#space .quality')}.join() === 'simulated,simulated,simulated,simulated'"
        )
        assert (await tab.value(texts("#space .value b")))[1].isdigit()
        assert await tab.value("document.querySelectorAll('#space .actions a').length") == 3
        await tab.click('button[aria-label="write mixer/steps"]')
        await tab.until('document.activeElement.closest(".editor")')
        await tab.type(STEPS)
        for _ in range(2):
            await tab.click(".editor button.main")
        await tab.until(f"{texts('.editor .result')}[0].includes('60039]: acknowledged')")
        await tab.until(f"{texts('#space .value')}[3].startsWith('[60000, 60001,')")
        assert (await tab.value(texts("#space .value")))[3].endswith(", …")
        assert tab.errors == []
        page.program.end(signal.SIGKILL)
        await tab.until('document.body.className === "stale"')
        assert await tab.value(texts("#space .quality")) == 4 * ["not live"]
        assert "Not live since" in await tab.value('document.querySelector("#lost").innerText')
        await calls_and_transfers_are_shown(tab)


async def calls_and_transfers_are_shown(tab: Tab) -> None:
    """By the same browser: each start of one takes long."""
    async with serving() as client:
        documents = client.north.changed
        documents["lines/far"] = calling()
        documents["transfers/2"] = transfer("carried", code="0", meaning="normal", time=LONG_AGO)
        documents["transfers/10"] = transfer("refused", why="251 is more than 250")
        await tab.open(f"http://127.0.0.1:{client.port}/#lines")
        await tab.until(f"{LIVE} && {texts('#transfers li')}.length === 2")
        [call] = await tab.value(texts("#calls li"))
        assert "idle for 4.0 s" in call
        assert "next call in 14 min, last result BUSY, 7 calls, 2 failed" in call
        [refused, carried] = await tab.value(texts("#transfers li"))
        assert refused.startswith("10: mixer/speed to oven/setpoint\nrefused\nnever carried")
        assert "251 is more than 250" in refused
        await tab.until(f"/carried\\n\\d+ d ago/.test({texts('#transfers li')}[1])")
        assert "0: normal" in carried
        wrong = " ".join(await tab.value(texts("#wrong li")))
        assert "transfer 10 waits for oven" in wrong  # which is silent
        assert "line far: the last call failed" in wrong
        del documents["transfers/10"], documents["lines/far"]  # a reload
        await tab.until(f"{texts('#transfers li')}.length === 1")
        assert await tab.value('document.querySelector("#calls-section").hidden')
        assert tab.errors == []
