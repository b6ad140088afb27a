"""The programs that build a release, and what they leave: bill of materials, wheel, archive.

`make release` compares two builds bit by bit, and .ci/smoke installs the archive without a network:
both run in hosted CI. Here are their parts.
"""

import json
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
from hatchling.builders.wheel import WheelBuilder  # type: ignore[import-not-found, unused-ignore]
from packaging.utils import canonicalize_name

from gateway import __version__
from gateway.config import ConfigErrors, load
from tests.e2e.processes import ROOT
from tools.bundle import (
    MACHINES,
    PYTHONS,
    SBOM,
    archive,
    download,
    needed,
    pinned,
    requirements,
    wanted,
)
from tools.release import checksums, compare

BILL = json.loads((ROOT / SBOM).read_bytes())
PINS = (ROOT / "constraints.txt").read_text("utf-8")
RUNS = pinned(PINS, needed(ROOT / SBOM))


def test_the_bill_of_materials_is_of_this_version_and_these_pins() -> None:
    """`make sbom` writes it."""
    assert BILL["bomFormat"] == "CycloneDX"
    assert BILL["metadata"]["component"]["version"] == __version__
    versions: dict[str, str] = {
        canonicalize_name(one["name"]): one["version"] for one in BILL["components"]
    }
    assert versions.pop("uplot") in (ROOT / "docs/page.md").read_text("utf-8")
    assert {pin.name: str(pin.specifier) for pin in RUNS} == {
        name: f"=={version}" for name, version in versions.items()
    }
    assert all(one["licenses"] for one in BILL["components"])


def test_pins_that_are_not_in_the_bill_only_build_or_are_for_windows() -> None:
    builders = re.findall(r"^BUILDERS = (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)[0]
    names = {*re.findall(r"^([\w.-]+)==", PINS, re.MULTILINE)}
    windows = {*re.findall(r"^([\w.-]+)==\S+ ; sys_platform == 'win32'", PINS, re.MULTILINE)}
    assert names - {pin.name for pin in RUNS} == {*builders.split(), *windows}
    assert f"uninstall --yes \\\n        {builders}\n" in (ROOT / "Dockerfile").read_text()


def test_a_wheel_has_all_files_of_the_gateway_and_the_bill_of_materials(tmp_path: Path) -> None:
    [wheel] = WheelBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"])
    with zipfile.ZipFile(wheel) as packed:
        names = packed.namelist()
        [bill] = [name for name in names if ".dist-info/sboms/" in name]
        assert packed.read(bill) == (ROOT / SBOM).read_bytes()
    files = {path for path in (ROOT / "gateway").rglob("*") if path.is_file()}
    assert {name for name in names if name.startswith("gateway/")} == {
        str(path.relative_to(ROOT)) for path in files if "__pycache__" not in path.parts
    }


def packed(folder: Path, contents: dict[str, bytes]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(folder / "a.whl", "w") as wheel:
        for name, content in contents.items():
            wheel.writestr(zipfile.ZipInfo(name), content)


def test_two_builds_are_compared_to_the_bit(tmp_path: Path) -> None:
    one, other = tmp_path / "one", tmp_path / "other"
    packed(one, {"x.py": b"1", "y.py": b"2"})
    packed(other, {"x.py": b"1", "y.py": b"2"})
    assert compare(one, other) == []
    packed(other, {"y.py": b"2", "x.py": b"1"})
    assert compare(one, other) == ["a.whl: the same content, packed differently"]
    packed(other, {"x.py": b"1", "y.py": b"3"})
    (other / "b.json").write_bytes(b"")
    assert compare(one, other) == ["a.whl: y.py", "b.json: is in one build only"]


def test_the_checksums_are_those_that_sha256sum_reads(tmp_path: Path) -> None:
    packed(tmp_path, {"x.py": b"1"})
    sums = checksums(tmp_path)
    check = ["sha256sum", "--check", "--strict", "-"]
    done = subprocess.run(
        check, input=sums, cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, "a.whl: OK\n")


@pytest.mark.parametrize("python", PYTHONS)
@pytest.mark.parametrize("machine", MACHINES)
def test_an_archive_has_the_event_loop_only_where_it_has_wheels(machine: str, python: str) -> None:
    names = {pin.name for pin in wanted(RUNS, machine, python)}
    assert names >= {"eclipse-zenoh", "pydantic-core", "pyyaml", "serialx"}
    assert ("uvloop" in names) == (machine != "armv7l")
    assert "pywin32" not in names


def test_a_package_without_a_wheel_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path))
    pins = {pin: hashes for pin, hashes in RUNS.items() if pin.name == "uvloop"}
    [pin] = pins
    with pytest.raises(SystemExit) as refused:
        download(pins, "aarch64", "3.13", tmp_path)
    assert str(refused.value).startswith("aarch64, Python 3.13: no wheel")
    assert f"{pin.name}{pin.specifier}" in str(refused.value)


def test_an_archive_names_the_hash_of_each_of_its_files(tmp_path: Path) -> None:
    for machine in ("x86_64", "aarch64"):
        (tmp_path / f"uvloop-0.23.0-cp313-cp313-linux_{machine}.whl").write_bytes(machine.encode())
    [pin] = (pin for pin in RUNS if pin.name == "uvloop")
    text = requirements([pin], tmp_path)
    hashes = re.findall(r"--hash=sha256:(\w{64})", text)
    assert sorted(hashes) == sorted(line.split()[0] for line in checksums(tmp_path).splitlines())
    assert text.startswith("uvloop==0.23.0; ")


def test_an_archive_depends_on_its_contents_only(tmp_path: Path) -> None:
    made = []
    for name, mode in (("one", 0o600), ("other", 0o644)):
        folder = tmp_path / name / "plant"
        folder.mkdir(parents=True)
        for file in ("b", "a") if name == "one" else ("a", "b"):
            (folder / file).write_text(file)
            (folder / file).chmod(mode)
        made.append(archive(folder, 1_700_000_000))
    assert made[0].read_bytes() == made[1].read_bytes()
    with tarfile.open(made[0]) as tar:
        assert tar.getnames() == ["plant/a", "plant/b"]


def test_the_smoke_test_and_the_programs_can_be_run() -> None:
    for name in ("smoke", "audit", "run", "install-peers", "once-more"):
        assert (ROOT / ".ci" / name).stat().st_mode & 0o111


def test_the_gateway_reads_its_file_without_libyaml(tmp_path: Path) -> None:
    """PyYAML has no wheel for armv7; the archive has one without the part in C."""
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text("lines:\n  hall: {port: simulator, baudrate: fast}\n")
    program = (
        "import sys; sys.modules['yaml._yaml'] = None\n"
        "import yaml; from gateway.config import ConfigErrors, load\n"
        "print(yaml.__with_libyaml__, *(one.name for one in load(sys.argv[1]).lines))\n"
        "try: load(sys.argv[2])\n"
        "except ConfigErrors as faults: print(faults)\n"
    )
    with pytest.raises(ConfigErrors) as faults:
        load(wrong)
    done = subprocess.run(
        [sys.executable, "-c", program, ROOT / "config.example.yaml", wrong],
        capture_output=True,
        text=True,
        check=True,
    )
    lines = [line.name for line in load(ROOT / "config.example.yaml").lines]
    assert done.stdout == f"False {' '.join(lines)}\n{faults.value}\n"
