"""The project's own files agree: version, licence, typing, supported Pythons."""

import re
import subprocess
import sys
import tomllib
from importlib import resources
from pathlib import Path
from typing import Any

import pytest
import yaml

from gateway import __version__
from tests.e2e.processes import ROOT, plc_gateway

PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
PYTHONS = re.findall(
    r"Python :: (3\.\d+)", "\n".join(PROJECT["project"]["classifiers"]), re.MULTILINE
)


def test_the_package_has_one_version() -> None:
    assert "version" in PROJECT["project"]["dynamic"]
    assert PROJECT["tool"]["hatch"]["version"]["path"] == "gateway/__init__.py"


@pytest.mark.parametrize("argument", ["--version", "version"])
def test_the_command_line_prints_the_version(argument: str) -> None:
    done = plc_gateway(argument)
    assert done.code == 0
    assert done.out.split()[-1] == __version__


def test_the_changelog_begins_with_the_version() -> None:
    text = (ROOT / "CHANGELOG.md").read_text("utf-8")
    versions = re.findall(r"^## \[?([\d.]+)\]?", text, re.MULTILINE)
    assert versions[0] == __version__
    assert len(versions) == len(set(versions))


def test_the_package_is_typed() -> None:
    assert "Typing :: Typed" in PROJECT["project"]["classifiers"]
    assert resources.files("gateway").joinpath("py.typed").is_file()


def test_the_license_is_the_one_that_the_project_names() -> None:
    assert PROJECT["project"]["license"] == "Apache-2.0"
    [own, uplot] = PROJECT["project"]["license-files"]
    assert own == "LICENSE"
    assert (ROOT / uplot).read_text("utf-8").startswith("The MIT License (MIT)")
    text = (ROOT / "LICENSE").read_text("utf-8")
    assert text.split()[:4] == ["Apache", "License", "Version", "2.0,"]
    assert "END OF TERMS AND CONDITIONS" in text


def test_the_library_of_the_page_is_the_one_that_its_page_names() -> None:
    """The file is that of npm, as it is."""
    assets = ROOT / "gateway/parts/web/assets"
    text = (assets / "uplot.js").read_text("utf-8")
    [version] = re.findall(r"^/\*! \S+uPlot \(v([\d.]+)\) \*/", text)
    assert f"uPlot {version}" in (ROOT / "docs/page.md").read_text("utf-8")
    assert "MIT" in (assets / "uplot-license.txt").read_text("utf-8")


def test_the_container_is_built_with_every_file_that_the_build_needs() -> None:
    copied = re.findall(r"^COPY (?!--from)(.*)$", (ROOT / "Dockerfile").read_text(), re.MULTILINE)
    assert set(copied[0].split()) >= {"pyproject.toml", "README.md", "LICENSE"}
    assert copied[1] == "${PINS} constraints.txt"
    assert "\nARG PINS=constraints.txt\n" in (ROOT / "Dockerfile").read_text()


def test_the_lowest_supported_python_is_the_one_that_pip_accepts() -> None:
    assert PROJECT["project"]["requires-python"] == f">={PYTHONS[0]}"
    assert PROJECT["tool"]["mypy"]["python_version"] == PYTHONS[0]


def test_ci_uses_the_interpreter_that_it_is_given() -> None:
    assert "export PYTHON=" in (ROOT / ".ci/run").read_text()
    assert "$(PYTHON) -m venv" in (ROOT / "Makefile").read_text()


def test_every_target_of_the_makefile_is_phony_or_a_file() -> None:
    text = (ROOT / "Makefile").read_text()
    [phony] = re.findall(r"^\.PHONY: (.*)$", text, re.MULTILINE)
    targets = set(re.findall(r"^([a-z]+):", text, re.MULTILINE))
    assert targets == set(phony.split())


def pins(file: str) -> dict[str, str]:
    """Returns the pinned packages with their lines."""
    text = (ROOT / file).read_text().replace("\\\n", "")
    lines = re.findall(r"^([\w.-]+)(==.*)$", text, re.MULTILINE)
    assert len(lines) == len({name for name, _ in lines})
    return dict(lines)


def test_every_pinned_package_is_pinned_by_hashes_and_in_both_files_alike() -> None:
    of_all, own = pins("constraints-dev.txt"), pins("constraints.txt")
    assert {name: of_all[name] for name in own} == own
    assert [name for name, line in of_all.items() if "--hash=sha256:" not in line] == []
    for file in ("Makefile", "Dockerfile", "docs/deployment.md"):
        assert "--require-hashes --requirement constraints.txt" in (ROOT / file).read_text()


def test_the_container_with_bridges_has_the_packages_of_the_gateway_and_of_their_extras() -> None:
    of_all, own, bridges = (pins(f"constraints{kind}.txt") for kind in ("-dev", "", "-bridges"))
    assert own.items() <= bridges.items() <= of_all.items()
    extras = PROJECT["project"]["optional-dependencies"]
    assert {"asyncua", "aiomqtt", "protobuf"} <= bridges.keys() - own.keys()
    assert len(extras["mqtt"] + extras["opcua"]) == 3  # `make pins` names these two


def test_every_package_of_the_project_has_a_pin() -> None:
    def normal(name: str) -> str:
        return re.sub(r"[-_.]+", "-", name).lower()

    own = PROJECT["project"]["dependencies"]
    wanted = [*own, *PROJECT["project"]["optional-dependencies"]["dev"]]
    named = {normal(re.split(r"[~<>=;\[ ]", requirement)[0]) for requirement in wanted}
    assert named <= {normal(pin) for pin in pins("constraints-dev.txt")}
    needed = {normal(re.split(r"[~<>=;\[ ]", one)[0]) for one in own}
    assert needed <= {normal(pin) for pin in pins("constraints.txt")}


def test_dependency_updates_cover_every_ecosystem() -> None:
    updates = yaml.safe_load((ROOT / ".github/dependabot.yml").read_text("utf-8"))["updates"]
    places = {update["package-ecosystem"]: update["directory"] for update in updates}
    assert places == {
        "pip": "/",
        "npm": "/tests/interop",
        "github-actions": "/",
        "docker": "/",
    }
    assert (ROOT / "tests/interop/package.json").is_file()


@pytest.mark.parametrize("page", ["CONTRIBUTING.md", "SECURITY.md"])
def test_the_readme_names_the_projects_pages(page: str) -> None:
    assert (ROOT / page).is_file()
    assert f"({page})" in (ROOT / "README.md").read_text("utf-8")


def test_the_contributors_table_has_the_layers_in_the_order_of_their_imports() -> None:
    [layers] = [
        contract["layers"]
        for contract in PROJECT["tool"]["importlinter"]["contracts"]
        if contract["id"] == "layers"
    ]
    text = (ROOT / "docs/contributors/architecture.md").read_text("utf-8")
    rows = text.partition("| folder or module | question")[2].partition("\n\n")[0].splitlines()[2:]
    named = [
        name.removesuffix("/").removesuffix(".py")
        for row in rows
        for name in re.findall(r"`([^`]+)`", row.split("|")[1])
    ]
    assert named == [layer for layer in layers if layer != "__main__"]


def test_the_contributors_page_names_only_files_and_targets_that_exist() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
    paths = re.findall(r"`((?:gateway|tests|docs)/[\w./-]*)`", text)
    targets = re.findall(r"[`$] ?make ([a-z]+)", text)
    makefile = (ROOT / "Makefile").read_text()
    assert len(paths) >= 10
    assert [path for path in paths if not (ROOT / path).exists()] == []
    assert [name for name in targets if f"\n{name}:" not in makefile] == []


def test_an_old_python_is_named_before_anything_is_made(tmp_path: Path) -> None:
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        (tmp_path / name).write_bytes((ROOT / name).read_bytes())
    old = tmp_path / "python3.10"
    old.write_text(
        f"#!{sys.executable}\nimport sys\nsys.version_info = (3, 10, 13)\nexec(sys.argv[2])\n"
    )
    old.chmod(0o755)
    done = subprocess.run(
        ["make", "run", f"PYTHON={old}"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode != 0
    assert "This is Python 3.10, the gateway needs 3.11 or newer" in done.stderr
    assert not (tmp_path / ".venv").exists()
