"""Checks README.md and docs/: files load, programs run, commands, keys and links exist."""

import ast
import dataclasses
import json
import re
import shlex
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
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
    LineConfig,
    ZenohConfig,
    load,
    schema,
)
from gateway.config.commands import TO_ALL, every_command
from gateway.config.settings.sections import part_sections
from gateway.config.yaml.file import read_yaml
from gateway.contract import payload
from gateway.contract.access import certificates
from gateway.contract.documents.fleet import RemoteDocument
from gateway.contract.keys import Keys
from gateway.contract.meta import meta
from gateway.contract.problems import Problem
from gateway.engine.device.device_settings import DeviceSettings
from gateway.line.send_permit import SendPermit
from gateway.northbound.group.standby import GroupSettings, Standby
from gateway.northbound.session.exposures import exposures
from gateway.parts.history.historian import Historian
from gateway.parts.notify.outbox import Outbox
from gateway.protocols.registry import PROTOCOLS
from gateway.tags import Reason, WriteResult, bad, good
from gateway.tags.tag import READ
from tests.e2e.processes import ROOT, Program, plc_gateway, started, until, until_exit
from tests.zenoh_peer import free_endpoint, free_port

README = ROOT / "README.md"
DOCS = sorted((ROOT / "docs").rglob("*.md"))
PAGES = [README, *DOCS]
OWN = [ROOT / name for name in ("CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md")]
FOLDERS = (ROOT / "docs", ROOT / "docs" / "contributors")
TEXT = {
    "/README.md" if page == README else page.relative_to(FOLDERS[0]).as_posix(): page.read_text(
        "utf-8"
    )
    for page in PAGES
}
EXAMPLE = ROOT / "config.example.yaml"
ENDPOINT = "tcp/127.0.0.1:7447"
# Indented where it stands in a list.
FENCED = re.compile(r"^( *)```(\w+)\n(.*?)^\1```$", re.DOTALL | re.MULTILINE)
# The blocks of this page are single devices: complete files are in examples/.
OF_DEVICES = "no-protocol.md"
# The pages whose Python programs run here against the example gateway.
OF_PROGRAMS = (
    *("read-values.md", "slow-links.md", "write-values.md", "write-groups.md"),
    *("browse.md", "contract.md", "provenance.md"),
)
# The tutorial's programs run in tests/e2e/test_story.py, the library's in
# tests/protocols/test_library.py; the replay is a test of tests/cases; the
# loop in architecture.md is pseudo code.
RUN_ELSEWHERE = (
    *("scada.md", "library.md"),
    *("contributors/wire-log-to-test.md", "contributors/architecture.md"),
)


class Block(NamedTuple):
    """One block of code; `line` is its first line in the page."""

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
    """Starts the example gateway on a free port, with `blocks: true`; yields its file."""
    text = EXAMPLE.read_text("utf-8")
    page = ("127.0.0.1:8080", f"127.0.0.1:{free_port()}")
    for old, new in ((ENDPOINT, free_endpoint()), page, ("# blocks: true ", "blocks: true ")):
        assert text.count(old) == 1
        text = text.replace(old, new)
    path = tmp_path_factory.mktemp("docs") / "config.yaml"
    path.write_text(text, encoding="utf-8")
    with started(path) as program:
        for _ in range(3):
            program.says("device online")
        until_exit(0, plc_gateway, "read", path)
        yield path


@pytest.fixture(scope="module")
def endpoint(running: Path) -> str:
    return load(running).zenoh.listen[0]


def shape(line: str) -> str:
    """Replaces everything that differs from one run to the next."""
    line = re.sub(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d+(Z|[+-]\d\d:\d\d)", "TIME", line)
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
        *(
            "first-plant.md",
            "fleet.md",
            "identity.md",
            "import.md",
            "peek.md",
            "serve.md",
            "shaping.md",
            "systems.md",
            "device-servers.md",
            "share.md",
            "notify.md",
            "connections.md",
            "fx.md",
        ),
        *("modem.md", "transfers.md"),
        *("templates.md", "trace.md", "alarms.md", "arrays.md"),
        *("tutorial-computer-link.md", "tutorial-modbus.md", "tutorial-vigor.md"),
    }
    assert sum(counted.values()) >= 11
    assert {block.page for block in DEVICES} == {OF_DEVICES}
    assert len(DEVICES) >= 7
    assert "```yml" not in "".join(TEXT.values())


@pytest.mark.parametrize("block", FILES, ids=str)
def test_a_file_in_the_pages_loads(block: Block, tmp_path: Path) -> None:
    for name in re.findall(r"[\w.-]+\.csv\b", block.text):
        (tmp_path / name).write_text("Name,Address\nspeed,D100\n")  # sheets of tags
    for name in re.findall(r"[\w.-]+\.(?:pem|key)\b", block.text):
        (tmp_path / name).touch()
    (tmp_path / "files").mkdir()  # of a fleet
    assert loaded(block.text, tmp_path).devices


@pytest.mark.parametrize("block", SECTIONS_ALONE, ids=str)
def test_a_section_in_the_pages_loads_with_lines_below(block: Block, tmp_path: Path) -> None:
    lines = yaml.safe_load(EXAMPLE.read_text("utf-8"))["lines"]
    for name in re.findall(r"[\w.-]+\.(?:pem|key|txt|json5)\b", block.text):
        (tmp_path / name).touch()  # files that a section names
    assert loaded(block.text + "\n" + json.dumps({"lines": lines})[1:-1], tmp_path).devices


@pytest.mark.parametrize("block", DEVICES, ids=str)
def test_a_device_in_the_pages_loads_on_a_line_of_its_own(block: Block, tmp_path: Path) -> None:
    devices = yaml.safe_load(block.text)
    assert {device["protocol"] for device in devices.values()} == {"frames"}
    serial = {"baudrate": 9600, "format": "8N1"}
    lines = {
        name: {**serial, "port": f"/dev/ttyS{number}", "devices": {name: made}}
        for number, (name, made) in enumerate(devices.items())
    }
    assert len(loaded(json.dumps({"lines": lines}), tmp_path).devices) == len(devices)


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
    """The text in the backquotes of a cell."""
    match = re.fullmatch(r"`([^`]*)`", cell)
    return match[1] if match else ""


DEFAULTS_OF_PROTOCOLS = table("configuration-protocols.md", "Defaults of the protocols", "protocol")


def settings(heading: str) -> dict[str, str]:
    """The settings of a section with the defaults that its page names."""
    page = "configuration-protocols.md" if heading in PROTOCOLS else "configuration.md"
    if heading in ("alarm", "alarms"):
        page = "alarms.md"
    if heading == "Settings":
        page = "transfers.md"
    rows = table(page, heading, "setting")
    if heading == "A tag":
        rows += table("shaping.md", "Settings", "setting")
    return {bare(name): bare(default) for name, _, default, _ in rows}


# The settings of served lines are on the page about them.
SERVED = {
    "A line": "Settings of a served line",
    "A device": "Settings of a station",
    "A tag": "Settings of its tags",
}


def documented(heading: str) -> set[str]:
    """The settings of a section on its page, and those of served lines."""
    served = table("serve.md", SERVED[heading], "setting") if heading in SERVED else []
    return {*settings(heading), *(bare(name) for name, *_ in served)}


def properties(*names: str) -> set[str]:
    shapes = schema()["$defs"]
    return set[str].union(*(set(shapes[name]["properties"]) for name in names))


@pytest.mark.parametrize(
    ("heading", "shape"),
    [
        *(("gateway", "GatewaySection"), ("zenoh", "ZenohSection"), ("tls", "TlsSection")),
        *(("writers", "WritersSection"), ("history", "HistorySection")),
        *(("alarm", "AlarmSection"), ("alarms", "AlarmsSection"), ("Settings", "Transfer")),
        *(("web", "WebSection"), ("A line", "Line"), ("A tag", "Tag"), ("write", "WriteSection")),
    ],
)
def test_every_setting_of_a_section_is_on_the_page_and_no_other(heading: str, shape: str) -> None:
    assert documented(heading) == properties(shape)


_ALIKE = {"modbus-ascii": "modbus-rtu"}


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_every_setting_of_a_protocol_is_on_the_page_and_no_other(protocol: str) -> None:
    common = documented("A device")
    own = set() if protocol == "fx" else set(settings(_ALIKE.get(protocol, protocol)))
    if protocol == "modbus-tcp":
        own |= set(settings("modbus-rtu"))
    assert common | own == properties(protocol)
    assert not common & own


def test_every_section_of_the_file_is_on_the_page() -> None:
    pages = CONFIGURATION + TEXT["templates.md"] + TEXT["remote.md"]
    headings = set(re.findall(r"^## (\w+)$", pages, re.MULTILINE))
    assert set(schema()["properties"]) - {"defaults", "lines"} <= headings


def _plant(section: str, name: str, text: str) -> dict[str, Any]:
    """A file with this value of one setting; without a text the setting is left out."""
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
            if protocol == "fx" or (not text and name == "station"):
                del device["station"]
            if protocol == "frames":
                fields = {"f": {"type": "text"}}
                ask = {"a": {"send": "A", "match": "(?P<f>.)", "fields": fields}}
                device = {"protocol": protocol, "framing": {"ending": "CR"}, "ask": ask}
                tag["address"] = "f"
                del tag["write"]
                line["port"] = "/dev/ttyS1"
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
    # The defaults of a line come from its protocol.
    assert {section for section, _, _ in DEFAULTS} >= set(SECTIONS) - {"A line"}


@pytest.mark.parametrize(("section", "name", "default"), DEFAULTS)
def test_a_default_on_the_page_is_the_default_of_the_gateway(
    section: str, name: str, default: str, tmp_path: Path
) -> None:
    said = loaded(json.dumps(_plant(section, name, default)), tmp_path)
    left_out = _plant(section, name, "")
    if (section, name) == ("A tag", "write"):
        del left_out["lines"]["hall"]["devices"]["plc"]["tags"]["tag"]["write"]
    assert repr(said) == repr(loaded(json.dumps(left_out), tmp_path))


@pytest.mark.parametrize("row", DEFAULTS_OF_PROTOCOLS)
def test_the_defaults_of_a_protocol_on_the_page_are_those_of_the_gateway(
    row: list[str], tmp_path: Path
) -> None:
    protocol, *times, word = map(bare, row)
    left_out = _plant(protocol, "", "")
    said = _plant(protocol, "", "")
    line = said["lines"]["hall"]
    device = line["devices"]["plc"]
    if word:
        device["tags"]["tag"]["type"] = word
    for name, text in zip(TIMES, times, strict=True):
        if text:
            owner = line if name in ("baudrate", "format") else device
            owner[name] = text if name == "format" else yaml.safe_load(text)
    told, default = (repr(loaded(json.dumps(each), tmp_path)) for each in (said, left_out))
    assert told == default.replace("learn_silence=True", "learn_silence=False")


def test_the_page_has_the_defaults_of_every_protocol() -> None:
    assert {bare(row[0]) for row in DEFAULTS_OF_PROTOCOLS} == set(PROTOCOLS)


@pytest.mark.parametrize(
    ("written", "read"), table("configuration.md", "How values are written", "written")
)
def test_yaml_is_read_as_the_page_shows(written: str, read: str, tmp_path: Path) -> None:
    path = tmp_path / "one.yaml"
    path.write_text(bare(written) + "\n")
    [value] = read_yaml(path, frozenset({"address", "format", "unit"}))[0].data.values()
    assert json.dumps(value) == bare(read)


def _refusals() -> list[list[str]]:
    _, _, rows = CONFIGURATION.partition("These are refused:\n\n")
    rows = rows.partition("\n\n")[0]
    return [[cell.strip() for cell in row.split("|")[1:-1]] for row in rows.splitlines()[2:]]


@pytest.mark.parametrize(("written", "because"), _refusals())
def test_a_value_that_the_page_calls_refused_is_refused_with_this_message(
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


def test_every_setting_has_an_effect() -> None:
    rooms = [one for one in (ROOT / "gateway").iterdir() if one.name != "config"]
    files = [path for room in rooms for path in room.rglob("*.py")]
    code = "".join(path.read_text("utf-8") for path in files)
    parts = (Config, LineConfig, DeviceSettings, ZenohConfig)
    unused = {
        field.name
        for part in parts
        for field in dataclasses.fields(part)
        if not re.search(rf"\.{field.name}\b", code)
    }
    for one in part_sections():
        unused |= {name for name in one.settings.model_fields if f".{name}" not in code}
    assert unused == set()


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
    # The command is parsed, not executed. A mention without arguments gets some.
    commands[name].make_context(name, arguments or ["plant.yaml"] * _wants(commands[name]))


def _wants(command: Any) -> int:
    return sum(
        1 for param in command.params if param.param_type_name == "argument" and param.required
    )


def test_the_reference_lists_every_command_and_every_option() -> None:
    group: Any = typer.main.get_command(cli)
    listed = [name.split()[0] for name in names("commands.md", "Commands", "command")]
    assert [*dict.fromkeys(listed)] == list(group.commands)
    single = {name: one for name, one in group.commands.items() if not hasattr(one, "commands")}
    for name, group_of in group.commands.items() - single.items():
        single |= {f"{name} {sub}": command for sub, command in group_of.commands.items()}
        single |= {name: group_of} if group_of.invoke_without_command else {}
    options = {
        (name, option)
        for name, command in single.items()
        for param in command.params
        if param.param_type_name == "option"
        for option in (*param.opts, *param.secondary_opts)
    }
    on_page = {
        (name, option.split()[0])
        for cell, commands, _ in table("commands.md", "Options", "option")
        for option in re.findall(r"`(.*?)`", cell)
        for name in re.findall(r"`(.*?)`", commands)
    }
    on_page |= {("scan", option) for option in names("commands.md", "Options of scan", "option")}
    assert options == on_page


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
    for page in [*PAGES, *OWN]:
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


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_the_index_names_every_page(folder: Path) -> None:
    index = (folder / "README.md").read_text("utf-8")
    named = re.findall(r"^\| \[([\w.-]+)\]", index, re.MULTILINE)
    assert sorted(named) == sorted({page.name for page in folder.glob("*.md")} - {"README.md"})


def _example_keys() -> set[str]:
    config = load(EXAMPLE)
    keys = Keys(config.zenoh.prefix, config.name)
    tags = [tag.key for device in config.devices for tag in device.tags]
    devices = [device.name for device in config.devices]
    return {
        *(key for tag in tags for key in (keys.value(tag), keys.set(tag), keys.meta(tag))),
        *(key for n in devices for key in (keys.device(n), keys.block(n), keys.command(n, "peek"))),
        *map(keys.set, devices),
        *(keys.status(f"devices/{name}") for name in devices),
        *(keys.status(f"lines/{line.name}") for line in config.lines),
        *(keys.trace(line.name) for line in config.lines),
        *(keys.alive(name) for name in devices),
        *(
            keys.own,
            keys.status("alarms"),
            keys.status("alarms/**"),
            keys.status("audit/*"),
            keys.status("status"),
            keys.status("transfers/1"),
            keys.writes,
            keys.status("page"),
            keys.status("page/samples"),
        ),
        *(
            keys.command(name, command)
            for name, commands in every_command(config).items()
            for command in commands
        ),
        *(keys.status(f"lines/{line.name}/{TO_ALL}") for line in config.lines),
        *(
            keys.describe,
            keys.introspect,
            keys.claim("1a2b"),
            keys.late,
            f"{keys.group('hall')}/**",
        ),
    }


def test_every_key_in_the_pages_is_one_of_the_examples() -> None:
    known = _example_keys()
    shown = {
        (page, key)
        for page, text in TEXT.items()
        if page not in ("bridges.md", "integrate.md")  # topics of MQTT
        for key in re.findall(r"(?<![\w/.-])plant/[^\s`\"'?,)}]+", text)
    }
    assert len(shown) >= 30
    wrong = [
        (page, key)
        for page, key in shown
        if not any(zenoh.KeyExpr(key).intersects(zenoh.KeyExpr(one)) for one in known)
    ]
    assert wrong == []


# ---- programs, and docs/zenoh.md ---------------------------------------------------------------


class Snippet(NamedTuple):
    """A program and the lines that it prints; the line `…` stands for further lines."""

    program: Block
    shown: list[str]

    def __str__(self) -> str:
        return str(self.program)


def _snippets() -> list[Snippet]:
    return [
        Snippet(block, after.text.splitlines())
        for page in OF_PROGRAMS
        for block, after in pairwise(_blocks(page))
        if block.language == "python"
    ]


SNIPPETS = _snippets()


def test_every_program_runs_here_or_in_a_test_of_its_own() -> None:
    programs = sum(TEXT[page].count("```python\n") for page in OF_PROGRAMS)
    assert len(SNIPPETS) == programs >= 13
    others = [text for page, text in TEXT.items() if page not in (*OF_PROGRAMS, *RUN_ELSEWHERE)]
    assert "```python" not in "".join(others)


@pytest.mark.parametrize("snippet", SNIPPETS, ids=str)
def test_a_program_prints_what_the_page_shows(
    snippet: Snippet, endpoint: str, tmp_path: Path
) -> None:
    text = snippet.program.text
    assert text.count(ENDPOINT) == 1
    assert _imported(text) <= {"datetime", "hashlib", "hmac", "json", "secrets", "zenoh"}
    path = tmp_path / "program.py"
    path.write_text(text.replace(ENDPOINT, endpoint), encoding="utf-8")
    shown = [line for line in snippet.shown if line != "…"]
    assert shown
    shapes = Counter(map(shape, shown))
    with Program(sys.executable, path) as program:
        if "…" in snippet.shown:  # some programs never end by themselves

            def printed_all() -> bool:
                return set(shapes) <= set(map(shape, program.lines))

            until(lambda: printed_all() or not program.running, "it prints what the page shows")
            if not program.running:
                program.ended()  # all that it printed is read
        else:
            assert program.ended() == 0
            assert Counter(map(shape, program.lines)) == shapes
        assert set(shapes) <= set(map(shape, program.lines))


def _imported(text: str) -> set[str]:
    nodes = list(ast.walk(ast.parse(text)))
    assert not any(isinstance(node, ast.ImportFrom) for node in nodes)
    return {name.name for node in nodes if isinstance(node, ast.Import) for name in node.names}


def names(page: str, heading: str, first: str) -> list[str]:
    """The texts in backquotes in the first column of a table."""
    return [name for row in table(page, heading, first) for name in re.findall(r"`(.*?)`", row[0])]


def test_every_error_word_and_every_reason_is_explained() -> None:
    assert set(names("zenoh.md", "A write", "`error`")) == set(Problem)
    assert set(names("zenoh.md", "A value", "`reason`")) == set(Reason)


def test_the_answer_to_a_write_has_the_fields_of_the_page() -> None:
    answer = json.loads(payload.outcome(WriteResult(7, 0, 0.1, origin="simulated")))
    assert set(names("zenoh.md", "A write", "in the answer")) == set(answer)


def test_a_value_has_the_fields_of_the_page() -> None:
    simulated = load(EXAMPLE).devices[0].tags[0]
    tag = replace(simulated, origin=READ)
    [shown] = [block for block in _blocks("zenoh.md") if block.language == "json"]
    known = [good(tag, 12.5, 0), bad(tag, Reason.NO_REPLY, 0, "No byte came back")]
    known.append(good(simulated, 12.5, 0))
    assert [list(json.loads(line)) for line in shown.text.splitlines()] == [
        list(json.loads(payload.value(sample))) for sample in known
    ]


def test_a_description_has_the_fields_of_the_page() -> None:
    tag = load(EXAMPLE).devices[0].tags[0]
    sentence = TEXT["zenoh.md"].partition("A description holds ")[2].partition(": `null`")[0]
    assert set(re.findall(r"`(\w+)`", sentence)) == set(json.loads(meta(tag)))


def test_the_status_documents_have_the_fields_of_the_page(endpoint: str, tmp_path: Path) -> None:
    program = next(block for block, _ in SNIPPETS if "devices/*" in block.text).text
    head = program.partition("with zenoh.open")[0].replace(ENDPOINT, endpoint)
    path = tmp_path / "program.py"
    path.write_text(f"{head}with zenoh.open(config) as session:\n{_DOCUMENTS}")
    with Program(sys.executable, path) as asking:
        assert asking.ended() == 0
        found = dict(line.split(maxsplit=1) for line in asking.lines)
    known: dict[str, Any] = {"history": Historian(tmp_path / "history.db", 1, 10**8).document()}
    known |= Standby(GroupSettings("hall"), None, Keys("plant", "demo"), SendPermit()).documents()
    known["certificates/"] = certificates.document(tmp_path, 0.0, 0.0)
    known["notify/"] = Outbox(1.0).document()
    known["remote/"] = dict.fromkeys(RemoteDocument.__annotations__)  # compared in tests/remote
    for key, text in found.items():
        path_there = re.sub(r"/.*", "/", key.removeprefix("plant/@gateway/demo/"))
        known[path_there] = json.loads(text)
    on_page = {
        bare(document): names(page_of(document), heading(bare(document)), "field")
        for document, _ in table("zenoh.md", "State and statistics", "document")
    }
    assert {document.partition("<")[0] for document in on_page} == set(known)
    for document, fields in on_page.items():
        published = known[document.partition("<")[0]]
        assert {field.partition(".")[0] for field in fields} == set(published), document
        for field, nested in published.items():
            found = nested[0] if isinstance(nested, list) and nested else nested
            inside = {name.partition(".")[2] for name in fields if name.startswith(f"{field}.")}
            assert not inside or inside == set(found), f"{document}: {field}"


def page_of(document: str) -> str:
    """The page with the fields of a status document."""
    pages = {
        "`doors": "share.md",
        "`notify": "notify.md",
        "`report`": "fleet.md",
        "`remote": "remote.md",
    }
    return pages.get(document.partition("/")[0], "status.md")


def heading(document: str) -> str:
    """The heading of a status document: Markdown takes a bare `<line>` for HTML."""
    return document.replace("<", "&lt;").replace(">", "&gt;")


_DOCUMENTS = """\
    for reply in session.get("plant/@gateway/**"):
        print(reply.ok.key_expr, reply.ok.payload.to_string())
"""


def test_the_warning_of_an_unprotected_gateway_is_the_one_of_the_page() -> None:
    [shown] = [block for block in _blocks("security.md") if block.language == "text"]
    config = zenoh.Config()
    config.insert_json5("listen/endpoints", json.dumps(["tcp/0.0.0.0:7447"]))
    assert exposures(config) == [shown.text.strip()]


# ---- form --------------------------------------------------------------------------------------

LONGEST_PAGE = 250
WIDEST_LINE = 100
FORMED = [*PAGES, *OWN]
# Table rows cannot be wrapped; output and payloads are shown as they are.
UNWRAPPED = re.compile(r"^\||^\{\"|^\$ (sqlite3|python3) |^other machines can reach |^plant/\S+ \{")


@pytest.mark.parametrize("page", FORMED, ids=lambda page: page.name)
def test_a_page_is_short_and_its_lines_are_wrapped(page: Path) -> None:
    lines = page.read_text("utf-8").splitlines()
    assert len(lines) <= LONGEST_PAGE or page.name == "CHANGELOG.md"  # it grows until a release
    wide = [line for line in lines if len(line) > WIDEST_LINE and not UNWRAPPED.match(line)]
    assert wide == []


def test_no_page_uses_a_word_that_hides_the_actor() -> None:
    """The rule of CONTRIBUTING.md: name the client, the device or the person."""
    vague = re.compile(r"\b(nobody|somebody|whoever|anybody|anew)\b", re.IGNORECASE)
    found = [
        (page.name, match[0])
        for page in FORMED
        for match in vague.finditer(re.sub(r"`[^`]*`", "", page.read_text("utf-8")))
        if page.name != "CONTRIBUTING.md"
    ]
    assert found == []


def test_the_example_of_a_replay_is_the_one_that_the_suite_runs() -> None:
    [shown] = [
        block for block in _blocks("contributors/wire-log-to-test.md") if block.language == "python"
    ]
    assert shown.text in (ROOT / "tests/cases/test_wire_logs.py").read_text("utf-8")
    [log] = [
        block for block in _blocks("contributors/wire-log-to-test.md") if block.language == "text"
    ]
    kept = (ROOT / "tests/cases/late_reply_and_bad_address/wire.log").read_text("utf-8")
    assert set(log.text.splitlines()) <= set(kept.splitlines())
