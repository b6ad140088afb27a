"""What README.md and docs/ say is so: files load, programs run, commands, keys and links exist."""

import ast
import dataclasses
import json
import re
import shlex
import sys
from collections import Counter
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from textwrap import dedent
from typing import Any, NamedTuple

import pytest
import typer.main
import yaml
import zenoh

from gateway.cli.main import cli
from gateway.config import (
    Config,
    ConfigErrors,
    HistoryConfig,
    LineConfig,
    ZenohConfig,
    load,
    schema,
)
from gateway.config.commands import TO_ALL, every_command
from gateway.config.yaml_file import read_yaml
from gateway.engine.device import DeviceSettings
from gateway.history import Historian
from gateway.northbound import StandbySettings, payload
from gateway.northbound.keys import Keys
from gateway.northbound.payload import Problem
from gateway.northbound.standby import Standby
from gateway.protocols.registry import PROTOCOLS
from gateway.tags import Reason, WriteResult, bad, good
from tests.e2e.processes import ROOT, Program, plc_gateway, started, until
from tests.zenoh_peer import free_endpoint

README = ROOT / "README.md"
DOCS = sorted((ROOT / "docs").glob("*.md"))
PAGES = [README, *DOCS]
TEXT = {page.name if page != README else "/README.md": page.read_text("utf-8") for page in PAGES}
EXAMPLE = ROOT / "config.example.yaml"
ENDPOINT = "tcp/127.0.0.1:7447"
# Indented where it stands in a list.
FENCED = re.compile(r"^( *)```(\w+)\n(.*?)^\1```$", re.DOTALL | re.MULTILINE)
# Its blocks are single devices, for they go into files like those of the other pages.
OF_DEVICES = "no-protocol.md"


class Block(NamedTuple):
    """A block of code: its page, its language, its first line in the page, its text."""

    page: str
    language: str
    line: int
    text: str

    def __str__(self) -> str:
        return f"{self.page.lstrip('/')}:{self.line}"


def blocks(*languages: str) -> list[Block]:
    return [block for page in TEXT for block in _blocks(page) if block.language in languages]


def _blocks(page: str) -> Iterator[Block]:
    for match in FENCED.finditer(TEXT[page]):
        line = TEXT[page].count("\n", 0, match.start()) + 2
        yield Block(page, match[2], line, dedent(match[3]))


def prose(page: str) -> str:
    """The page without its blocks of code."""
    return FENCED.sub("", TEXT[page])


# ---- a gateway to try it on --------------------------------------------------------------------


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The file of the example gateway, which runs: as it is, but for the port and `blocks`."""
    text = EXAMPLE.read_text("utf-8")
    for old, new in ((ENDPOINT, free_endpoint()), ("# blocks: true ", "blocks: true ")):
        assert text.count(old) == 1
        text = text.replace(old, new)
    path = tmp_path_factory.mktemp("docs") / "config.yaml"
    path.write_text(text, encoding="utf-8")
    with started(path) as program:
        for _ in range(3):
            program.says("device online")
        until(lambda: plc_gateway("read", path).code == 0, "every value is good")
        yield path


@pytest.fixture(scope="module")
def endpoint(running: Path) -> str:
    return load(running).zenoh.listen[0]


def shape(line: str) -> str:
    """The line without what differs from one run to the next."""
    line = re.sub(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d+Z", "TIME", line)
    line = re.sub(r"\b(True|False|true|false)\b", "BOOL", line)
    return re.sub(r"(?<![\w.])-?\d+(\.\d+)?(?![\w.])", "N", line)


# ---- YAML --------------------------------------------------------------------------------------

TOP = schema()["properties"]
FILES = [block for block in blocks("yaml") if re.search(r"^lines:", block.text, re.MULTILINE)]
_PARTS = [block for block in blocks("yaml") if block not in FILES]
SECTIONS_ALONE = [block for block in _PARTS if set(yaml.safe_load(block.text)) <= set(TOP)]
DEVICES = [block for block in _PARTS if block not in SECTIONS_ALONE]


def test_every_page_with_files_is_checked() -> None:
    counted = Counter(block.page for block in FILES)
    assert set(counted) == {
        *("/README.md", "configuration.md", "vigor.md", "computer-link.md", "modbus.md"),
    }
    assert sum(counted.values()) >= 11
    assert {block.page for block in DEVICES} == {OF_DEVICES}
    assert len(DEVICES) >= 7
    assert "```yml" not in "".join(TEXT.values())


@pytest.mark.parametrize("block", FILES, ids=str)
def test_a_file_in_the_pages_loads(block: Block, tmp_path: Path) -> None:
    assert loaded(block.text, tmp_path).devices


@pytest.mark.parametrize("block", SECTIONS_ALONE, ids=str)
def test_a_section_in_the_pages_loads_with_lines_below(block: Block, tmp_path: Path) -> None:
    lines = yaml.safe_load(EXAMPLE.read_text("utf-8"))["lines"]
    for name in re.findall(r"[\w.-]+\.(?:pem|key|txt|json5)\b", block.text):
        (tmp_path / name).touch()  # files that a section names
    assert loaded(block.text + "\n" + json.dumps({"lines": lines})[1:-1], tmp_path).devices


@pytest.mark.parametrize("block", DEVICES, ids=str)
def test_a_device_in_the_pages_loads_as_soon_as_its_protocol_is_there(
    block: Block, tmp_path: Path
) -> None:
    devices = yaml.safe_load(block.text)  # no settings of a file: each device on a line of its own
    assert {device["protocol"] for device in devices.values()} == {"frames"}
    serial = {"baudrate": 9600, "format": "8N1"}
    lines = {
        name: {**serial, "port": f"COM{number}", "devices": {name: made}}
        for number, (name, made) in enumerate(devices.items())
    }
    text = json.dumps({"lines": lines})
    if "frames" in PROTOCOLS:
        assert len(loaded(text, tmp_path).devices) == len(devices)
        return
    with pytest.raises(ConfigErrors) as told:
        loaded(text, tmp_path)
    unknown = [told for told in told.value.messages if "'frames' is no protocol" in told]
    assert len(unknown) == len(devices)


def loaded(text: str, folder: Path) -> Any:
    path = folder / "plant.yaml"
    path.write_text(text, encoding="utf-8")
    return load(path)


# ---- docs/configuration.md ---------------------------------------------------------------------

CONFIGURATION = TEXT["configuration.md"]
TIMES = ("baudrate", "format", "reply_timeout", "silence", "retries")


def table(page: str, heading: str, first: str) -> list[list[str]]:
    """The rows of the table below a heading whose first column is called `first`."""
    below = re.split(rf"^#+ {re.escape(heading)}$", TEXT[page], flags=re.MULTILINE)[1]
    below = re.split(r"^#+ ", below, flags=re.MULTILINE)[0]
    _, _, rows = below.partition(f"\n| {first} |")
    assert rows, f"{page} has no table of {first} below {heading}"
    rows = rows.partition("\n\n")[0]
    return [[cell.strip() for cell in row.split("|")[1:-1]] for row in rows.splitlines()[2:]]


def bare(cell: str) -> str:
    """What is in the backquotes of a cell."""
    match = re.fullmatch(r"`([^`]*)`", cell)
    return match[1] if match else ""


def settings(heading: str) -> dict[str, str]:
    """The settings of a section of the page, with the defaults that it names."""
    rows = table("configuration.md", heading, "setting")
    return {bare(name): bare(default) for name, _, default, _ in rows}


def properties(*names: str) -> set[str]:
    shapes = schema()["$defs"]
    return set[str].union(*(set(shapes[name]["properties"]) for name in names))


@pytest.mark.parametrize(
    ("heading", "shape"),
    [
        *(("gateway", "GatewaySection"), ("zenoh", "ZenohSection"), ("tls", "TlsSection")),
        *(("writers", "WritersSection"), ("history", "HistorySection")),
        *(("web", "WebSection"), ("A line", "Line"), ("A tag", "Tag"), ("write", "WriteSection")),
    ],
)
def test_every_setting_of_a_section_is_on_the_page_and_no_other(heading: str, shape: str) -> None:
    assert set(settings(heading)) == properties(shape)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_every_setting_of_a_protocol_is_on_the_page_and_no_other(protocol: str) -> None:
    common = set(settings("A device"))
    own = set(settings({"modbus-ascii": "modbus-rtu"}.get(protocol, protocol)))
    if protocol == "modbus-tcp":
        own |= set(settings("modbus-rtu"))
    assert common | own == properties(protocol)
    assert not common & own


def test_every_section_of_the_file_is_on_the_page() -> None:
    headings = set(re.findall(r"^## (\w+)$", CONFIGURATION, re.MULTILINE))
    assert set(schema()["properties"]) - {"defaults", "lines"} <= headings


def _plant(section: str, name: str, text: str) -> dict[str, Any]:
    """A file in which a setting has this value, or (without a text) is left out."""
    value = yaml.safe_load(text) if text else None
    setting = {name: value} if text else {}
    tag: dict[str, Any] = {"address": "D1", "write": {}}
    device: dict[str, Any] = {"protocol": "vigor", "station": 1}
    line: dict[str, Any] = {"port": "simulator"}
    top: dict[str, Any] = {}
    match section:
        case "gateway" | "zenoh" | "history" | "web":
            top = {section: setting}
        case "tls":
            top = {"zenoh": {"tls": setting}}
        case "A line":
            line |= setting
        case "A device":
            device |= setting
        case "A tag":
            tag |= setting | ({"type": "float32"} if name == "word_order" else {})
            if name == "history":
                top = {"history": {}}
        case "write":
            tag["write"] = setting
        case protocol:
            address = "holding:1" if protocol.startswith("modbus") else "D1"
            tag["address"] = address
            device = {"protocol": protocol, "station": 1, **setting}
            if not text and name == "station":
                del device["station"]
            if protocol == "frames":
                fields = {"f": {"type": "text"}}
                ask = {"a": {"send": "A", "match": "(?P<f>.)", "fields": fields}}
                device = {"protocol": protocol, "framing": {"ending": "CR"}, "ask": ask}
                tag["address"] = "f"
                del tag["write"]
                line["port"] = "COM1"
    return {
        **top,
        "lines": {"hall": {**line, "devices": {"plc": {**device, "tags": {"tag": tag}}}}},
    }


SECTIONS = ["gateway", "zenoh", "tls", "history", "web", "A line", "A device", "A tag", "write"]
DEFAULTS = [
    (section, name, default)
    for section in [*SECTIONS, "vigor", "computer-link", "modbus-rtu", "modbus-tcp"]
    for name, default in settings(section).items()
    if default
]


def test_most_defaults_are_checked() -> None:
    assert len(DEFAULTS) >= 35
    # What a line leaves out is as its protocol is used to, or found out.
    assert {section for section, _, _ in DEFAULTS} >= set(SECTIONS) - {"A line"}


@pytest.mark.parametrize(("section", "name", "default"), DEFAULTS)
def test_a_default_on_the_page_is_what_holds_when_nothing_is_said(
    section: str, name: str, default: str, tmp_path: Path
) -> None:
    said = loaded(json.dumps(_plant(section, name, default)), tmp_path)
    left_out = _plant(section, name, "")
    if (section, name) == ("A tag", "write"):
        del left_out["lines"]["hall"]["devices"]["plc"]["tags"]["tag"]["write"]
    assert repr(said) == repr(loaded(json.dumps(left_out), tmp_path))


@pytest.mark.parametrize("row", table("configuration.md", "What a protocol is used to", "protocol"))
def test_the_customs_of_a_protocol_are_what_holds_when_nothing_is_said(
    row: list[str], tmp_path: Path
) -> None:
    protocol, *customs, word = map(bare, row)
    left_out = _plant(protocol, "", "")
    said = _plant(protocol, "", "")
    line = said["lines"]["hall"]
    device = line["devices"]["plc"]
    if word:
        device["tags"]["tag"]["type"] = word
    for name, text in zip(TIMES, customs, strict=True):
        if text:
            owner = line if name in ("baudrate", "format") else device
            owner[name] = text if name == "format" else yaml.safe_load(text)
    assert repr(loaded(json.dumps(said), tmp_path)) == repr(loaded(json.dumps(left_out), tmp_path))


def test_every_protocol_has_its_customs() -> None:
    rows = table("configuration.md", "What a protocol is used to", "protocol")
    assert {bare(row[0]) for row in rows} == set(PROTOCOLS)


@pytest.mark.parametrize(
    ("written", "read"), table("configuration.md", "How values are written", "written")
)
def test_yaml_is_read_as_the_page_says(written: str, read: str, tmp_path: Path) -> None:
    path = tmp_path / "one.yaml"
    path.write_text(bare(written) + "\n")
    [value] = read_yaml(path, frozenset({"address", "format", "unit"}))[0].data.values()
    assert json.dumps(value) == bare(read)


def _refusals() -> list[list[str]]:
    _, _, rows = CONFIGURATION.partition("These are refused:\n\n")
    rows = rows.partition("\n\n")[0]
    return [[cell.strip() for cell in row.split("|")[1:-1]] for row in rows.splitlines()[2:]]


@pytest.mark.parametrize(("written", "because"), _refusals())
def test_what_the_page_calls_refused_is_refused_in_these_words(
    written: str, because: str, tmp_path: Path
) -> None:
    tag = f"{{address: D1, {bare(written)}}}"
    if bare(written).startswith("adress"):
        tag = f"{{{bare(written)}}}"
    device = f"{{protocol: vigor, tags: {{t: {tag}}}}}"
    text = f"lines: {{a: {{port: simulator, devices: {{m: {device}}}}}}}"
    with pytest.raises(ConfigErrors, match=re.escape(because)):
        loaded(text, tmp_path)


def test_the_schema_beside_the_example_is_the_gateways() -> None:
    """`make schema` writes it."""
    assert json.loads((ROOT / "config.schema.json").read_text("utf-8")) == schema()


def test_what_the_page_calls_without_effect_is_what_nothing_follows_from() -> None:
    section = CONFIGURATION.partition("## Not in effect yet")[2]
    files = [path for path in (ROOT / "gateway").rglob("*.py") if path.parent.name != "config"]
    code = "".join(path.read_text("utf-8") for path in files)
    parts = (Config, LineConfig, DeviceSettings, ZenohConfig, HistoryConfig)
    unused = {
        field.name
        for part in parts
        for field in dataclasses.fields(part)
        if not re.search(rf"\.{field.name}\b", code)
    }
    assert unused == set(re.findall(r"`(\w+)`", section))


# ---- commands ----------------------------------------------------------------------------------


def _commands() -> Iterator[tuple[str, str]]:
    for page in TEXT:
        shown: list[str] = re.findall(r"`([^`]+)`", prose(page))
        for block in _blocks(page):
            if block.language in ("console", "ini"):
                shown += re.findall(r"^(?:\$ |ExecStart=)(.*)$", block.text, re.MULTILINE)
        for code in shown:
            if re.match(r"\S*plc-gateway\s+[a-z]", code):
                yield page.lstrip("/"), code


COMMANDS = list(_commands())


def test_commands_are_found() -> None:
    assert len(COMMANDS) >= 15
    pages = {page for page, _ in COMMANDS}
    assert pages >= {"README.md", "operations.md", "configuration.md"}


@pytest.mark.parametrize(("page", "command"), COMMANDS)
def test_a_command_in_the_pages_is_one_with_its_options(page: str, command: str) -> None:
    _, name, *arguments = shlex.split(command)
    group: Any = typer.main.get_command(cli)
    commands = group.commands
    assert name in commands, f"{page}: there is no command {name}"
    # Parsed, and not carried out; where it is mentioned without its arguments, these are missing.
    commands[name].make_context(name, arguments or ["plant.yaml"] * _wants(commands[name]))


def _wants(command: Any) -> int:
    return sum(
        1 for param in command.params if param.param_type_name == "argument" and param.required
    )


def test_the_plan_in_the_readme_is_the_one_that_check_prints(tmp_path: Path) -> None:
    [plan] = [block for block in _blocks("/README.md") if block.language == "text"]
    [file] = [block for block in FILES if block.page == "/README.md"]
    path = tmp_path / "plant.yaml"
    path.write_text(file.text)
    shown = [line.strip() for line in plan.text.splitlines() if line.strip()]
    printed = [line.strip() for line in plc_gateway("check", path).out.splitlines()]
    assert shown == printed[: len(shown)]


def test_the_write_in_the_readme_is_answered_as_shown(running: Path) -> None:
    [console] = [block for block in _blocks("/README.md") if " write config" in block.text]
    command, shown = console.text.strip().splitlines()[-2:]
    name, *arguments = shlex.split(command)[2:]
    done = plc_gateway(name, *(running if word == EXAMPLE.name else word for word in arguments))
    assert (done.code, shape(done.out.strip())) == (0, shape(shown))


# ---- links and keys ----------------------------------------------------------------------------


def _links() -> Iterator[tuple[Path, str]]:
    for page in [*PAGES, ROOT / "CHANGELOG.md"]:
        for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text("utf-8")):
            if "://" not in target:
                yield page, target


def _anchors(page: Path) -> set[str]:
    heads = re.findall(r"^#+ (.*)$", page.read_text("utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


def test_every_link_leads_somewhere() -> None:
    links = list(_links())
    assert len(links) >= 30
    dead = []
    for page, target in links:
        path, _, anchor = target.partition("#")
        file = (page.parent / path) if path else page
        if not file.exists() or (anchor and anchor not in _anchors(file)):
            dead.append(f"{page.name}: {target}")
    assert dead == []


def test_the_index_names_every_page() -> None:
    named = re.findall(r"^\| \[([\w.-]+)\]", TEXT["README.md"], re.MULTILINE)
    assert set(named) == {page.name for page in DOCS} - {"README.md"}


def _example_keys() -> set[str]:
    config = load(EXAMPLE)
    keys = Keys(config.zenoh.prefix, config.name)
    tags = [tag.key for device in config.devices for tag in device.tags]
    devices = [device.name for device in config.devices]
    return {
        *(key for tag in tags for key in (keys.value(tag), keys.set(tag), keys.meta(tag))),
        *(key for name in devices for key in (keys.device(name), keys.block(name))),
        *(keys.status(f"devices/{name}") for name in devices),
        *(keys.status(f"lines/{line.name}") for line in config.lines),
        *(keys.own, keys.status("status"), keys.writes),
        *(
            keys.command(name, command)
            for name, commands in every_command(config).items()
            for command in commands
        ),
        *(keys.status(f"lines/{line.name}/{TO_ALL}") for line in config.lines),
        *(keys.late, f"{keys.group('hall')}/**"),
    }


def test_every_key_in_the_pages_is_one_of_the_examples() -> None:
    known = _example_keys()
    shown = {
        (page, key)
        for page, text in TEXT.items()
        for key in re.findall(r"(?<![\w/.-])plant/[^\s`\"'?,)}]+", text)
    }
    assert len(shown) >= 30
    wrong = [
        (page, key)
        for page, key in shown
        if not any(zenoh.KeyExpr(key).intersects(zenoh.KeyExpr(one)) for one in known)
    ]
    assert wrong == []


# ---- docs/zenoh.md -----------------------------------------------------------------------------


class Snippet(NamedTuple):
    """A program of the page and what it says that it prints; `…` among that is: and so on."""

    program: Block
    shown: list[str]

    def __str__(self) -> str:
        return str(self.program)


def _snippets() -> list[Snippet]:
    found = list(_blocks("zenoh.md"))
    return [
        Snippet(block, after.text.splitlines())
        for block, after in pairwise(found)
        if block.language == "python"
    ]


SNIPPETS = _snippets()


def test_every_program_is_run_and_says_what_it_prints() -> None:
    assert len(SNIPPETS) == TEXT["zenoh.md"].count("```python\n") >= 11
    # Those of scada.md are run by tests/test_story.py.
    others = [text for page, text in TEXT.items() if page not in ("zenoh.md", "scada.md")]
    assert "```python" not in "".join(others)


@pytest.mark.parametrize("snippet", SNIPPETS, ids=str)
def test_a_program_prints_what_the_page_shows(
    snippet: Snippet, endpoint: str, tmp_path: Path
) -> None:
    text = snippet.program.text
    assert text.count(ENDPOINT) == 1
    assert _imported(text) <= {"json", "zenoh"}
    path = tmp_path / "program.py"
    path.write_text(text.replace(ENDPOINT, endpoint), encoding="utf-8")
    shown = [line for line in snippet.shown if line != "…"]
    assert shown
    shapes = Counter(map(shape, shown))
    with Program(sys.executable, path) as program:
        if "…" in snippet.shown:  # some go on for ever: they are ended here

            def said_all() -> bool:
                return set(shapes) <= set(map(shape, program.lines))

            until(lambda: said_all() or not program.running, "it says what the page shows")
        else:
            assert program.ended() == 0
            assert Counter(map(shape, program.lines)) == shapes
        assert set(shapes) <= set(map(shape, program.lines))


def _imported(text: str) -> set[str]:
    nodes = list(ast.walk(ast.parse(text)))
    assert not any(isinstance(node, ast.ImportFrom) for node in nodes)
    return {name.name for node in nodes if isinstance(node, ast.Import) for name in node.names}


def names(page: str, heading: str, first: str) -> list[str]:
    """What is in backquotes in the first column of a table."""
    return [name for row in table(page, heading, first) for name in re.findall(r"`(.*?)`", row[0])]


def test_every_error_word_and_every_reason_is_explained() -> None:
    assert set(names("zenoh.md", "A write", "`error`")) == set(Problem)
    assert set(names("zenoh.md", "A value", "`reason`")) == set(Reason)


def test_the_answer_to_a_write_has_the_fields_of_the_page() -> None:
    answer = json.loads(payload.outcome(WriteResult(7, 0, 0.1)))
    assert set(names("zenoh.md", "A write", "in the answer")) == set(answer)


def test_a_value_has_the_fields_of_the_page() -> None:
    tag = load(EXAMPLE).devices[0].tags[0]
    [shown] = [block for block in _blocks("zenoh.md") if block.language == "json"]
    known = [good(tag, 12.5, 0), bad(tag, Reason.NO_REPLY, 0, "No byte came back")]
    assert [list(json.loads(line)) for line in shown.text.splitlines()] == [
        list(json.loads(payload.value(sample))) for sample in known
    ]


def test_a_description_has_the_fields_of_the_page() -> None:
    tag = load(EXAMPLE).devices[0].tags[0]
    sentence = TEXT["zenoh.md"].partition("A description holds ")[2].partition(": `null`")[0]
    assert set(re.findall(r"`(\w+)`", sentence)) == set(json.loads(payload.meta(tag)))


def test_the_status_documents_have_the_fields_of_the_page(endpoint: str, tmp_path: Path) -> None:
    program = next(block for block, _ in SNIPPETS if "devices/*" in block.text).text
    head = program.partition("with zenoh.open")[0].replace(ENDPOINT, endpoint)
    path = tmp_path / "program.py"
    path.write_text(f"{head}with zenoh.open(config) as session:\n{_DOCUMENTS}")
    with Program(sys.executable, path) as asking:
        assert asking.ended() == 0
        found = dict(line.split(maxsplit=1) for line in asking.lines)
    known: dict[str, Any] = {"history": Historian(tmp_path / "history.db", 1, 10**8).document()}
    known |= Standby(StandbySettings("hall"), Keys("plant", "demo"), zenoh.Config()).documents()
    for key, text in found.items():
        path_there = re.sub(r"/.*", "/", key.removeprefix("plant/@gateway/demo/"))
        known[path_there] = json.loads(text)
    rows = table("zenoh.md", "State and statistics", "document")
    on_page = {
        bare(document).partition("<")[0]: set(
            re.findall(r"`(\w+)`", re.sub(r"\(.*?\)|with .* in the file", "", fields))
        )
        for document, fields in rows
    }
    assert on_page == {path: set(document) for path, document in known.items()}


_DOCUMENTS = """\
    for reply in session.get("plant/@gateway/**"):
        print(reply.ok.key_expr, reply.ok.payload.to_string())
"""
