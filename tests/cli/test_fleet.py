"""The command `fleet`, and the reports that it shows."""

import json
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, cast
from urllib.request import urlopen

import orjson
import zenoh

from gateway.config import load
from gateway.config.loading import dumped
from gateway.contract.documents.fleet import ReportDocument
from gateway.contract.fleet_files import Wanted, wanted_in
from gateway.contract.fleet_rows import State, Told, rows, told_by
from tests.conftest import Command
from tests.e2e.processes import free_port, plc_gateway, started, until, write_config
from tests.northbound.access import PASSWORDS, ROUTER_RULES, rules, users
from tests.zenoh_peer import configured, free_endpoint

REPORT: dict[str, Any] = {
    "contract": 1,
    "name": "a",
    "version": "1.2.0",
    "time": "2026-11-24T12:00:00.000000Z",
    "up": 60.0,
    "tags": 3,
    "not_real": False,
    "lines": 1,
    "lines_down": 0,
    "devices": {"up": 1},
    "load": 0.25,
    "faults": {},
    "fault": "",
    "warnings": 0,
    "digest": "d1",
    "revision": None,
    "loaded": "2026-11-24T11:00:00.000000Z",
    "refused": None,
    "refused_why": "",
    "certificate_days": None,
    "disk_days": None,
    "group": None,
    "stand": None,
}
NOON = 1795521600.0
FILE = {
    "gateway": {"name": "a"},
    "zenoh": {"prefix": "works", "mode": "client", "connect": ["tcp/127.0.0.1:1"]},
    "lines": {
        "hall": {
            "port": "simulator",
            "devices": {
                "mixer": {"protocol": "vigor", "station": 1, "tags": {"speed": {"address": "D0"}}}
            },
        }
    },
}


def test_the_worst_gateway_comes_first_and_each_cause_has_a_sentence() -> None:
    def told(offset: float = 0.0, **more: Any) -> Told:
        return Told(cast("ReportDocument", REPORT | more), offset)

    fault: Any = {"faults": {"line-down": 2, "history": 1}, "fault": "line hall is down: no port"}
    found = rows(
        {
            "p/fault": told(**fault),
            "p/good": told(),
            "p/refused": told(refused=REPORT["time"], refused_why="f.yaml:3: no such setting"),
            "p/clock": told(offset=-61.0),
            "p/certificate": told(certificate_days=3.2),
            "p/disk": told(disk_days=2.0),
            "p/old": told(version="1.1.9"),
            "p/other": told(digest="d2"),
            "p/unknown": told(),
            "p/warned": told(warnings=2),
        },
        {
            f"p/{name}": Wanted(Path(f"{name}.yaml"), "d1")
            for name in (
                *("fault", "good", "refused", "clock", "certificate", "disk", "old", "other"),
                *("warned", "never"),
            )
        },
        {"p/gone": "2026-11-24T11:59:00.123456Z", "p/good": REPORT["time"]},
    )
    assert [(row.gateway, row.state, row.says) for row in found] == [
        ("p/gone", State.MISSING, "silent since 2026-11-24T11:59:00Z"),
        ("p/never", State.MISSING, "it never replied"),
        ("p/fault", State.FAULT, "line hall is down: no port, and 2 more"),
        ("p/certificate", State.LOOK, "a certificate ends in 3 days"),
        ("p/clock", State.LOOK, "its clock is -61 s off"),
        ("p/disk", State.LOOK, "its disk is full in 2 days"),
        ("p/old", State.LOOK, "version 1.1.9 is old"),
        ("p/other", State.LOOK, "its file differs from other.yaml"),
        ("p/refused", State.LOOK, "its changed file was refused: f.yaml:3: no such setting"),
        ("p/unknown", State.LOOK, "no file of the folder is its own"),
        ("p/warned", State.LOOK, "2 warnings: see its `status`"),
        ("p/good", State.GOOD, ""),
    ]


def test_a_report_that_nobody_can_read_is_said_and_the_others_count() -> None:
    def reply(key: str, **more: object) -> tuple[str, bytes, float]:
        return key, orjson.dumps(REPORT | more), NOON + 0.5

    told, mistakes = told_by(
        [
            reply("works/@gateway/a/report"),
            reply("works/north/@gateway/b/report", time="2026-11-24T12:01:00.500000Z"),
            reply("works/@gateway/twin/report"),
            reply("works/@gateway/twin/report"),
            reply("works/@gateway/next/report", contract=2),
            reply("works/@gateway/clock/report", time="yesterday"),
            reply("works/@gateway/short/report", faults=None),
            ("works/@gateway/noise/report", b"\xff\x00", NOON),
        ],
        NOON,
    )
    assert {name: round(one.offset, 3) for name, one in told.items()} == {
        "works/a": 0.0,
        "works/north/b": 60.0,
        "works/twin": 0.0,
    }
    for name in ("twin", "next", "clock", "short", "noise"):
        assert sum(f"works/{name}" in one for one in mistakes) == 1, name


def test_a_folder_of_files(tmp_path: Path) -> None:
    (tmp_path / "north").mkdir()
    other = FILE | {"gateway": {"name": "b"}}
    (tmp_path / "a.yaml").write_text(dumped(FILE))
    (tmp_path / "north" / "b.yaml").write_text("# the second\n" + dumped(other))
    (tmp_path / "same.yaml").write_text(dumped(other))
    (tmp_path / "wrong.yaml").write_text("lines: [")
    for other_program in ("pumps.yaml", ".git/config.yaml"):
        (tmp_path / other_program).parent.mkdir(exist_ok=True)
        (tmp_path / other_program).write_text("templates: {pump: {tags: {}}}")
    (tmp_path / "empty.yaml").touch()
    (tmp_path / "loop.yaml").symlink_to("loop.yaml")
    (tmp_path / "north" / "up").symlink_to("..")
    os.mkfifo(tmp_path / "pipe.yml")
    found, mistakes = wanted_in(tmp_path)
    assert found.keys() == {"works/a", "works/b"}
    assert len(mistakes) == 5
    for name in ("empty.yaml", "loop.yaml", "pipe.yml"):
        assert any(name in one for one in mistakes), name
    assert any("wrong.yaml" in one for one in mistakes)
    assert any("works/b is the gateway of" in one for one in mistakes)
    digests = {load(tmp_path / name).digest for name in ("north/b.yaml", "same.yaml")}
    assert digests == {found["works/b"].digest}
    assert digests != {found["works/a"].digest}


def test_the_digest_sees_a_sheet_and_no_comment(tmp_path: Path) -> None:
    device = {"protocol": "vigor", "station": 1, "tags_from": "tags.csv"}
    line = {"port": "simulator", "devices": {"mixer": device}}
    file, sheet = tmp_path / "a.yaml", tmp_path / "tags.csv"
    digests = []
    for comment, address in (("", "D0"), ("# speed\n", "D0"), ("", "D1")):
        file.write_text(comment + dumped(FILE | {"lines": {"hall": line}}))
        sheet.write_text(f"name,address\nspeed,{address}\n")
        digests.append(load(file).digest)
    assert digests[0] == digests[1] != digests[2]


def _reply(key: str, payload: bytes, query: zenoh.Query) -> None:
    query.reply(key, payload)


@contextmanager
def gateways(endpoint: str, *names: str) -> Iterator[None]:
    """Something that replies like gateways do."""
    setup = zenoh.Config()
    setup.insert_json5("mode", '"router"')
    setup.insert_json5("listen/endpoints", json.dumps([endpoint]))
    setup.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(setup) as session:
        for name in names:
            key = f"works/@gateway/{name}/report"
            strange = {"revision": "=1+1", "version": "9" * 5000}  # of another program
            member = {"group": "hall", "stand": "waiting"}
            more = {"b": member, "c": strange}.get(name, {})
            payload = orjson.dumps(REPORT | {"name": name} | more)
            session.declare_queryable(key, partial(_reply, key, payload))
        yield


def test_the_command_as_a_table_json_and_csv(tmp_path: Path) -> None:
    endpoint, remember = free_endpoint(), tmp_path / "seen.json"
    (tmp_path / "files").mkdir()
    (tmp_path / "files" / "c.yaml").write_text(dumped(FILE | {"gateway": {"name": "c"}}))
    asked = ("fleet", "works", "--connect", endpoint, "--remember", remember)
    with gateways(endpoint, "a", "b"):
        done = plc_gateway(*asked)
        assert done.code == 0, done.err
        assert re.search(r"^works/a +\w+ +1\.2\.0 +1 min +3 +1 up +25% +d1", done.out, re.MULTILINE)
        assert re.search(r"^works/b +\w+ \(hall: waiting\) +1\.2\.0", done.out, re.MULTILINE)
    with gateways(endpoint, "a"):
        done = plc_gateway(*asked, "--json", "--folder", tmp_path / "files")
        found = {one["gateway"]: one for one in map(json.loads, done.out.splitlines())}
        assert done.code == 1
        assert found["works/b"]["says"] == "silent since 2026-11-24T12:00:00Z"
        assert found["works/c"]["says"] == "it never replied"
        assert found["works/a"]["drift"] == "no file"
        done = plc_gateway(*asked, "--csv")
        assert done.out.splitlines()[0].startswith("gateway,state,says,drift,clock_offset,")
        assert len(done.out.splitlines()) == 3
    with gateways(endpoint, "c"):
        done = plc_gateway("fleet", "works", "--connect", endpoint, "--csv")
        assert ",'=1+1," in done.out


def test_the_page_of_a_gateway_has_those_that_reply_to_its_query(tmp_path: Path) -> None:
    endpoint, port = free_endpoint(), free_port()
    file = write_config(
        tmp_path / "office.yaml",
        endpoint,
        cast("dict[str, Any]", FILE["lines"]),
        gateway={"name": "office"},
        zenoh={"prefix": "works", "mode": "client", "listen": [], "connect": [endpoint]},
        web={"listen": f"127.0.0.1:{port}", "fleet": True},
    )
    with gateways(endpoint, "a", "b"), started(file):
        with urlopen(f"http://127.0.0.1:{port}/api/fleet", timeout=60) as reply:
            found = json.load(reply)
        assert {one["gateway"] for one in found["gateways"]} == {
            *("works/a", "works/b", "works/office")
        }
        with urlopen(f"http://127.0.0.1:{port}/", timeout=60) as reply:
            assert b"fleet.js" in reply.read()


def test_access_control_needs_the_key_of_the_reports(tmp_path: Path) -> None:
    """As docs/fleet.md says."""
    endpoint, key, access = free_endpoint(), "plant/**/@gateway/*/report", rules(ROUTER_RULES)
    for rule in access["rules"]:
        if rule["id"] in ("ask", "tell", "offer", "asked"):
            rule["key_exprs"].append(key)
    access["policies"].append({"rules": ["ask", "tell"], "subjects": ["gateways"]})
    own = {"access_control": access, "transport/auth/usrpwd/dictionary_file": str(users(tmp_path))}

    def opened(name: str, mode: str = "client", **more: Any) -> zenoh.Session:
        user = {"user": name, "password": PASSWORDS[name]}
        config = {f"transport/auth/usrpwd/{field}": value for field, value in user.items()}
        setup: dict[str, Any] = {"mode": mode, "listen": [], "connect": [endpoint], **more}
        return zenoh.open(configured(setup | {"config": config | setup.get("config", {})}))

    with (
        opened("gateway", "router", listen=[endpoint], connect=[], config=own),
        opened("gateway") as gateway,
        opened("viewer") as viewer,
        opened("gateway") as page,
    ):
        replies = ["plant/@gateway/a/report", "plant/north/@gateway/b/report"]
        kept = [gateway.declare_queryable(one, partial(_reply, one, b"{}")) for one in replies]
        for asking in (viewer, page):
            until(lambda who=asking: _found(who, key) == replies, "both replied")  # type: ignore[misc]
        assert len(kept) == 2


def _found(session: zenoh.Session, key: str) -> list[str]:
    return sorted(str(one.ok.key_expr) for one in session.get(key, timeout=5) if one.ok)


def test_a_folder_that_is_none(command: Command, tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(dumped(FILE))
    for wrong in ("nowhere", "a.yaml"):
        done = command("fleet", "works", "--folder", tmp_path / wrong)
        assert (done.code, "is no folder" in done.err) == (2, True)
