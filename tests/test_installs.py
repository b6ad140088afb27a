"""Every sentence of the pages and messages that installs something: it works with what exists."""

import re
import subprocess
import sys
from importlib.metadata import version

import pytest
import yaml

from gateway import __version__
from tests.e2e.processes import ROOT

PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "Dockerfile")),
    *(ROOT / "docs").rglob("*.md"),
    *(path for path in (ROOT / "packaging").rglob("*") if path.is_file()),
    *(ROOT / "examples").rglob("*.py"),
    *(ROOT / "gateway").rglob("*.py"),
]
CONTINUED = re.compile(r" *\\\n\s*")
PLACE = re.compile(
    r"(?:\S*/)?\b(pipx?|uv|npm|apt|apt-get|conda|brew|docker) (?=install|build |tool)"
)
# The clone, its example, and the pinned packages: the same words are in Makefile and Dockerfile.
PINNED = "pip install --require-hashes --requirement constraints.txt"
CLONE = "pip install --no-deps --no-build-isolation ."
DRIVER = "pip install --no-deps --no-build-isolation examples/driver"
OFFLINE = (
    "pip install --no-index --find-links wheels --require-hashes --requirement requirements.txt"
)
# The same with the folder of a version.
UPGRADE = (
    OFFLINE.replace("install ", "install --quiet ")
    .replace(" wheels", " zenoh-plc-gateway-1.1.0-offline/wheels")
    .replace(" requirements.txt", " zenoh-plc-gateway-1.1.0-offline/requirements.txt")
)
IMAGE = "docker build -t plc-gateway ."
BRIDGES_IMAGE = "docker build --build-arg PINS=constraints-bridges.txt -t plc-gateway:bridges ."
PINNED_IMAGE = "docker build --build-arg BASE=python:3.12-slim@sha256:"
# Tried by the nightly workflow; it leads the fuzzer, and tests do without it.
BY_HAND = {"atheris"}


def installs(text: str) -> set[str]:
    """Returns the commands without the place of the program."""
    text = CONTINUED.sub(" ", text).replace("--no-cache-dir ", "")
    found = set()
    for match in PLACE.finditer(text):
        command = re.split(r"[`,\n…\"']| and | or | with |\)| &&", text[match.start(1) :])[0]
        found.add(command.strip())
    return found


COMMANDS = {
    command: page.name
    for page in PAGES
    if "__pycache__" not in page.parts
    for command in installs(page.read_text("utf-8"))
}


def packages() -> set[str]:
    by_name = [one.removeprefix("pip install ") for one in COMMANDS if " -" not in one]
    return {name for names in by_name for name in names.split()}


def test_every_sentence_that_installs_is_one_of_those_below() -> None:
    others = {command for command in COMMANDS if " -" in command}
    assert others == {PINNED, CLONE, DRIVER, OFFLINE, UPGRADE, IMAGE, BRIDGES_IMAGE, PINNED_IMAGE}
    assert {command for command in COMMANDS if not command.startswith(("pip ", "docker "))} == set()


def test_a_package_that_a_page_names_is_one_that_the_tests_run_with() -> None:
    pins = dict(
        re.findall(r"^([\w.-]+)==(\S+)", (ROOT / "constraints-dev.txt").read_text(), re.MULTILINE)
    )
    named = packages() - BY_HAND
    assert named >= {"eclipse-zenoh", "aiomqtt", "asyncua", "openpyxl", "pyarrow"}
    assert {name: version(name) for name in named} == {name: pins[name] for name in named}


@pytest.mark.parametrize(
    "command", [["--require-hashes", "--requirement", "constraints.txt"], [".", "examples/driver"]]
)
def test_pip_accepts_what_the_pages_install(command: list[str]) -> None:
    """Without a network: what is pinned is installed here, and clone and example can be built."""
    words = ["--dry-run", "--no-index", "--no-deps", "--no-build-isolation", *command]
    done = subprocess.run(
        [sys.executable, "-m", "pip", "install", *words],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_the_words_of_the_pages_are_those_of_makefile_image_and_smoke_test() -> None:
    makefile = (ROOT / "Makefile").read_text().replace("--quiet ", "")
    assert PINNED in makefile
    assert PINNED in installs((ROOT / "Dockerfile").read_text())
    assert CLONE in installs((ROOT / "Dockerfile").read_text())
    smoke = CONTINUED.sub(" ", (ROOT / ".ci/smoke").read_text())
    words = OFFLINE.removeprefix("pip install ")
    assert words in smoke
    assert words in CONTINUED.sub(" ", (ROOT / "tools/bundle.py").read_text().replace("\\\\", "\\"))


def test_the_image_is_built_from_files_that_exist() -> None:
    text = (ROOT / "Dockerfile").read_text().replace("${PINS}", "constraints-bridges.txt")
    assert re.search(r"^ARG BASE=python:[\w.-]+@sha256:[0-9a-f]{64}$", text, re.MULTILINE)
    assert {line.split()[1] for line in text.splitlines() if line.startswith("FROM")} == {"${BASE}"}
    copied = re.findall(r"^COPY (?!--from)(.*) \S+$", text, re.MULTILINE)
    assert {
        name for names in copied for name in names.split() if not (ROOT / name).exists()
    } == set()
    compose = yaml.safe_load((ROOT / "packaging/container/compose.yaml").read_text())
    assert (
        ROOT / "packaging/container" / compose["services"]["gateway"]["build"]
    ).resolve() == ROOT


@pytest.mark.parametrize("page", ["deployment.md", "release.md"])
def test_a_page_names_the_files_of_this_version(page: str) -> None:
    text = (ROOT / "docs" / page).read_text("utf-8")
    named = re.findall(r"zenoh[-_]plc[-_]gateway-(\d+\.\d+\.\d+)", text)
    assert set(named) == {__version__}


def test_every_target_that_a_page_names_exists() -> None:
    makefile = (ROOT / "Makefile").read_text()
    targets = {
        target
        for page in PAGES
        if page.suffix == ".md"
        for target in re.findall(
            r"(?:`|^\$ )make ([a-z.]+(?:/[a-z]+)?)", page.read_text("utf-8"), re.MULTILINE
        )
    }
    assert targets >= {"run", "test", "bundle", "release", ".venv/installed"}
    assert {target for target in targets if f"\n{target}:" not in makefile} == set()
