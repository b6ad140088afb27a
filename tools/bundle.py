"""Puts the gateway and the wheels of all its packages into one archive for machines offline.

The versions and hashes are those of constraints.txt.
"""

import hashlib
import io
import json
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name, parse_wheel_filename

OWN = "zenoh-plc-gateway"
SBOM = "packaging/sbom.cdx.json"
MACHINES = ("x86_64", "aarch64", "armv7l")
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
# PyPI has no wheel of these for armv7l. They are built here, without the parts in C.
FROM_SOURCE = {"armv7l": {"pyyaml": {"PYYAML_FORCE_LIBYAML": "0", "PYYAML_FORCE_CYTHON": "0"}}}
# The files for systemd, udev and certificates; a first configuration.
_BESIDE = ("packaging", "config.example.yaml", "LICENSE", "CHANGELOG.md")
_GLIBC = range(31, 16, -1)  # 2.31: Debian 11
_OLD = {"x86_64": ("manylinux2014", "manylinux2010", "manylinux1")}

_HOW = """\
Installs without a network on Linux with glibc 2.31 or newer (Debian 11) and Python {pythons},
on {machines}. Not on musl (Alpine): eclipse-zenoh has no wheel for it.

    python3 -m venv /opt/plc-gateway/{version}
    /opt/plc-gateway/{version}/bin/pip install --no-index --find-links wheels \\
        --require-hashes --requirement requirements.txt
    /opt/plc-gateway/{version}/bin/plc-gateway check config.example.yaml

A 32-bit system on a 64-bit kernel (`getconf LONG_BIT` says 32, `uname -m` aarch64): begin the
second line with `linux32`.
"""


def bundle(
    source: Path, wheel: Path, when: int, machines: Sequence[str], pythons: Sequence[str]
) -> Path:
    """Returns the archive, made beside the wheel of the gateway; all its files are of `when`."""
    version = str(parse_wheel_filename(wheel.name)[1])
    folder = wheel.parent / f"{OWN}-{version}-offline"
    wheels = folder / "wheels"
    wheels.mkdir(parents=True)
    shutil.copy(wheel, wheels)
    pins = pinned((source / "constraints.txt").read_text("utf-8"), needed(source / SBOM))
    for machine in machines:
        for python in pythons:
            download(pins, machine, python, wheels)
    own = Requirement(f"{OWN}=={version}")
    (folder / "requirements.txt").write_text(requirements([*pins, own], wheels))
    (folder / "INSTALL.txt").write_text(
        _HOW.format(version=version, machines=", ".join(machines), pythons=", ".join(pythons))
    )
    for name in _BESIDE:
        if (source / name).is_dir():
            shutil.copytree(source / name, folder / name)
        else:
            shutil.copy(source / name, folder / name)
    made = archive(folder, when)
    shutil.rmtree(folder)
    return made


def needed(sbom: Path) -> set[str]:
    """Returns the names of the packages that run; constraints.txt also has those that build."""
    return {canonicalize_name(one["name"]) for one in json.loads(sbom.read_bytes())["components"]}


def pinned(text: str, names: set[str]) -> dict[Requirement, list[str]]:
    """Returns the pins of these packages with their hashes."""
    pins = {}
    for line in text.replace("\\\n", "").splitlines():
        if not line.startswith("#"):
            pin, *hashes = line.split(" --hash=")
            requirement = Requirement(pin)
            if canonicalize_name(requirement.name) in names:
                pins[requirement] = [one.strip() for one in hashes]
    return pins


def wanted(pins: Iterable[Requirement], machine: str, python: str) -> list[Requirement]:
    """Returns what this machine needs. pip would look at the one that it runs on."""
    there: dict[str, Any] = {
        **default_environment(),
        "sys_platform": "linux",
        "os_name": "posix",
        "platform_system": "Linux",
        "platform_machine": machine,
        "python_version": python,
        "python_full_version": f"{python}.0",
    }
    return [one for one in pins if one.marker is None or one.marker.evaluate(there)]


def download(
    pins: Mapping[Requirement, list[str]], machine: str, python: str, wheels: Path
) -> None:
    """Fails with the name of a package that has no wheel."""
    sources = FROM_SOURCE.get(machine, {})
    ready = []
    for one in wanted(pins, machine, python):
        settings = sources.get(canonicalize_name(one.name))
        if settings is None:
            ready.append(one)
        else:
            built: list[str | Path] = [
                "wheel",
                "--no-build-isolation",
                "--no-binary",
                one.name,
                "--wheel-dir",
                wheels,
            ]
            _pip(built, {one: pins[one]}, f"{machine}: no wheel can be built", settings)
    command: list[str | Path] = ["download", "--only-binary", ":all:", "--dest", wheels]
    command += ["--implementation", "cp", "--python-version", python]
    old = _OLD.get(machine, ("manylinux2014",))
    for tag in (*(f"manylinux_2_{minor}" for minor in _GLIBC), *old):
        command += ["--platform", f"{tag}_{machine}"]
    _pip(command, {one: pins[one] for one in ready}, f"{machine}, Python {python}: no wheel", {})


def _pip(
    command: list[str | Path],
    pins: Mapping[Requirement, list[str]],
    fault: str,
    settings: Mapping[str, str],
) -> None:
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as file:
        for one, hashes in pins.items():
            hashed = " ".join(f"--hash={value}" for value in hashes)
            file.write(f"{one.name}{one.specifier} {hashed}\n")
        file.flush()
        tail = ["--quiet", "--no-deps", "--require-hashes", "--requirement", file.name]
        words = [sys.executable, "-m", "pip", *map(str, command), *tail]
        done = subprocess.run(
            words, env={**os.environ, **settings}, capture_output=True, text=True, check=False
        )
    if done.returncode != 0:
        lines = [line for line in done.stderr.splitlines() if line.startswith("ERROR")]
        raise SystemExit("\n".join([fault, *(lines or done.stderr.splitlines()[-9:])]))


def requirements(pins: Iterable[Requirement], wheels: Path) -> str:
    """Returns the lines for pip: each package with the hashes of its files in this folder."""
    hashes: dict[str, list[str]] = {}
    for file in sorted(wheels.iterdir()):
        name = parse_wheel_filename(file.name)[0]
        digest = hashlib.sha256(file.read_bytes()).hexdigest()
        hashes.setdefault(name, []).append(f"--hash=sha256:{digest}")
    return "".join(
        " \\\n    ".join([str(one), *hashes[canonicalize_name(one.name)]]) + "\n"
        for one in sorted(pins, key=lambda one: one.name)
        if canonicalize_name(one.name) in hashes
    )


def archive(folder: Path, when: int) -> Path:
    """Returns a tar file that depends on names, contents and `when` only. Wheels are compressed."""
    made = folder.with_name(f"{folder.name}.tar")
    with tarfile.open(made, "w", format=tarfile.PAX_FORMAT) as tar:
        for file in sorted(path for path in folder.rglob("*") if path.is_file()):
            content = file.read_bytes()
            entry = tarfile.TarInfo(str(file.relative_to(folder.parent)))
            entry.size, entry.mtime = len(content), when
            entry.mode = 0o755 if file.stat().st_mode & 0o100 else 0o644
            tar.addfile(entry, io.BytesIO(content))
    return made
