"""Runs every program of docs/scada.md against gateways that are set up as the page describes."""

import json
import subprocess
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import pytest
import yaml

from tests.e2e.processes import Program, plc_gateway, started, until, until_exit
from tests.northbound.access import GATEWAY_RULES, certificates, secret
from tests.test_docs import ENDPOINT, EXAMPLE, Block, _blocks, shape
from tests.zenoh_peer import free_endpoint

PAGE = "scada.md"
BLOCKS = list(_blocks(PAGE))
PROGRAMS = [(block, after) for block, after in pairwise(BLOCKS) if block.language == "python"]
OPEN, CLOSED = (block.text for block in BLOCKS if block.language == "json5")
[SECURED] = [yaml.safe_load(block.text) for block in BLOCKS if block.language == "yaml"]


class Story(NamedTuple):
    folder: Path  # with scada.json5
    config: Path


def set_up(folder: Path, zenoh: dict[str, object], client: str) -> Iterator[Story]:
    config = yaml.safe_load(EXAMPLE.read_text("utf-8"))
    config["zenoh"] |= zenoh
    config["history"] = {"path": "history.db", "keep": "7d", "max_size": "1GB"}
    config["defaults"]["history"] = True
    path = folder / "config.yaml"
    path.write_text(yaml.safe_dump(config), encoding="utf-8")
    (folder / "scada.json5").write_text(client, encoding="utf-8")
    with started(path) as program:
        for _ in range(3):
            program.says("device online")
        yield Story(folder, path)


@pytest.fixture(scope="module")
def beginning(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Story]:
    endpoint = free_endpoint()
    assert OPEN.count(ENDPOINT) == 1
    client = OPEN.replace(ENDPOINT, endpoint)
    for story in set_up(tmp_path_factory.mktemp("story"), {"listen": [endpoint]}, client):
        until_exit(0, plc_gateway, "read", story.config)
        yield story


@pytest.fixture(scope="module")
def end(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Story]:
    """The secured gateway of the last section, on this machine."""
    folder = tmp_path_factory.mktemp("end")
    certificates(folder)("gateway")
    secret(folder / "users.txt", "viewer:a long one\noperator:another\n")
    (folder / "access.json5").write_text(GATEWAY_RULES)
    port = free_endpoint().rpartition(":")[2]
    settings = SECURED["zenoh"] | {"listen": [f"tls/127.0.0.1:{port}"]}
    named = "tls/gateway.plant:7447"
    assert CLOSED.count(named) == CLOSED.count('"ca.pem"') == 1
    client = CLOSED.replace(named, f"tls/127.0.0.1:{port}")
    yield from set_up(folder, settings, client.replace('"ca.pem"', f'"{folder / "ca.pem"}"'))


def test_the_tutorial_fits_on_three_pages() -> None:
    assert len(PROGRAMS) == sum(block.language == "python" for block in BLOCKS) == 5
    assert sum(len(block.text.splitlines()) for block, _ in PROGRAMS) < 100


@pytest.mark.parametrize(("program", "shown"), PROGRAMS[:-1], ids=str)
def test_a_program_prints_what_the_page_shows(
    program: Block, shown: Block, beginning: Story
) -> None:
    path = beginning.folder / "program.py"
    path.write_text(inside(beginning, program.text), encoding="utf-8")
    lines = shown.text.splitlines()
    wanted = {shape(line) for line in lines if line != "…"}
    with Program(sys.executable, path) as running:
        if "…" in lines:

            def printed_all() -> bool:
                return wanted <= set(map(shape, running.lines))

            until(lambda: printed_all() or not running.running, "it prints what the page shows")
        else:
            assert running.ended() == 0
            assert [shape(line) for line in running.lines] == [shape(line) for line in lines]
        assert wanted <= set(map(shape, running.lines))


WRITING = next(block for block, _ in PROGRAMS if "def write(" in block.text)
DONE = '{"value": 7, "time": "", "verified": true, "took": 0.1}'
REFUSED = '{"error": "refused", "code": "28", "reason": "no such address"}'
UNCLEAR = '{"error": "unclear", "code": null, "reason": "no reply"}'
BUSY = '{"error": "busy", "code": null, "reason": "it could not be read"}'
GOOD = '{"value": 6, "quality": "good", "time": ""}'
BAD = '{"value": null, "quality": "bad", "reason": "no-reply", "time": ""}'
MUTE = ""
UNKNOWN = "unknown, and the PLC could not be read"
# Stands in for a gateway: gives these answers, or none (mute) until the query times out.
STAND_IN = """
import json, sys, zenoh

def answering(data):
    def answer(query):
        if not data:
            kept.append(query)
        elif "error" in data:
            query.reply_err(data, encoding=zenoh.Encoding.APPLICATION_JSON)
        else:
            query.reply(query.key_expr, data, encoding=zenoh.Encoding.APPLICATION_JSON)
    return answer

config, answers, kept = zenoh.Config.from_json5(sys.argv[1]), json.loads(sys.argv[2]), []
with zenoh.open(config) as session:
    told = [session.declare_queryable(key, answering(data)) for key, data in answers.items()]
    print("there", flush=True)
    sys.stdin.read()
"""


@pytest.mark.parametrize(
    ("answers", "said"),
    [
        ((DONE, MUTE), "done: 7"),
        ((REFUSED, GOOD), "not done: refused, no such address"),
        ((UNCLEAR, GOOD), "unknown; the PLC now holds 6"),
        ((UNCLEAR, BAD), UNKNOWN),
        ((UNCLEAR, BUSY), UNKNOWN),
        ((MUTE, GOOD), "unknown; the PLC now holds 6"),
        ((MUTE, MUTE), UNKNOWN),
        ((), UNKNOWN),
    ],
)
def test_a_write_is_done_or_not_done_or_unknown(
    answers: tuple[str, ...], said: str, tmp_path: Path
) -> None:
    endpoint = free_endpoint()
    stand_in = {"listen": {"endpoints": [endpoint]}, "scouting": {"multicast": {"enabled": False}}}
    answered = dict(zip(("plant/**/@set", "plant/mixer/*"), answers, strict=False))
    text, client = inside(Story(tmp_path, tmp_path), WRITING.text), OPEN
    if answers[:1] == (MUTE,):
        text = text.replace("timeout=10.0", "timeout=0.2")
    if answers[1:] == (MUTE,):
        client = client.replace("{ mode:", "{ queries_default_timeout: 200, mode:")
    (tmp_path / "scada.json5").write_text(client.replace(ENDPOINT, endpoint), encoding="utf-8")
    path = tmp_path / "program.py"
    path.write_text(text, encoding="utf-8")
    command = (sys.executable, "-c", STAND_IN, json.dumps(stand_in), json.dumps(answered))
    with Program(*command) as gateway:
        gateway.says("there")
        with Program(sys.executable, path) as program:
            assert program.ended() == 0
            assert program.lines == [said] * 3


def test_a_viewer_of_the_secured_gateway_reads_and_does_not_write(end: Story) -> None:
    program, shown = PROGRAMS[-1]
    command = [sys.executable, "-c", program.text]

    def printed() -> str:
        done = subprocess.run(command, cwd=end.folder, capture_output=True, text=True, check=True)
        return done.stdout

    until(lambda: printed() == shown.text, "it prints what the page shows")


def inside(story: Story, program: str) -> str:
    """The program with the full path of its file: the tests start it in another folder."""
    assert program.count('"scada.json5"') == 1
    return program.replace("scada.json5", str(story.folder / "scada.json5"))
