"""Builds wheel, sdist, bill of materials and offline archive of the last commit in dist/.

Builds all twice, in different surroundings, and fails if a bit is different.
"""

import argparse
import hashlib
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from pathlib import Path

from tools.bundle import MACHINES, PYTHONS, SBOM, bundle

ROOT = Path(__file__).parents[1]
# What may differ between two machines: names, time zone, umask, order of hashes.
_SURROUNDINGS = (
    ("one", "UTC", 0o022, {"PYTHONHASHSEED": "1", "LC_ALL": "C.UTF-8"}),
    ("another place", "Asia/Taipei", 0o077, {"PYTHONHASHSEED": "2", "LC_ALL": "C"}),
)


def main() -> None:
    """Leaves the files and SHA256SUMS in dist/."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--machines", default=" ".join(MACHINES))
    parser.add_argument("--pythons", default=" ".join(PYTHONS))
    chosen = parser.parse_args()
    if _git("status", "--porcelain"):
        raise SystemExit("commit first: a release is built from the last commit only")
    when = int(_git("log", "-1", "--format=%ct"))
    with tempfile.TemporaryDirectory() as place:
        made = []
        for name, zone, mask, settings in _SURROUNDINGS:
            surroundings = {**settings, "TZ": zone, "SOURCE_DATE_EPOCH": str(when)}
            os.umask(mask)
            source, out = Path(place, name, "source"), Path(place, name, "out")
            _export(source)
            wheel = build(source, out, surroundings)
            bundle(source, wheel, when, chosen.machines.split(), chosen.pythons.split())
            shutil.copyfile(source / SBOM, out / f"{wheel.name.partition('-py3')[0]}.cdx.json")
            made.append(out)
        os.umask(_SURROUNDINGS[0][2])
        if differences := compare(*made):
            raise SystemExit("\n".join(["the two builds are not equal:", *differences]))
        dist = ROOT / "dist"
        shutil.rmtree(dist, ignore_errors=True)
        shutil.copytree(made[0], dist)
    sums = checksums(dist)
    (dist / "SHA256SUMS").write_text(sums)
    print(f"built twice, the same bits, of {_git('rev-parse', 'HEAD')}in dist/:\n{sums}", end="")


def _git(*words: str) -> str:
    return _run(ROOT, {}, "git", *words)


def _run(folder: Path, settings: dict[str, str], *command: str | Path) -> str:
    """Returns what a program printed that must succeed."""
    done = subprocess.run(
        [*map(str, command)],
        cwd=folder,
        env={**os.environ, **settings},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        raise SystemExit(f"{' '.join(map(str, command))} failed:\n{done.stdout}{done.stderr}")
    return done.stdout


def _export(folder: Path) -> None:
    """Writes the files of the commit, and no others, into a new folder."""
    folder.mkdir(parents=True)
    packed = folder.with_suffix(".tar")
    _git("archive", "--format=tar", f"--output={packed}", "HEAD")
    with tarfile.open(packed) as tar:
        tar.extractall(folder, filter="data")


def build(source: Path, out: Path, surroundings: dict[str, str]) -> Path:
    """Returns the wheel. It is built from the sdist, which is left beside it."""
    command = ("-m", "build", "--no-isolation", "--outdir", out, source)
    _run(source, surroundings, sys.executable, *command)
    [wheel] = out.glob("*.whl")
    with zipfile.ZipFile(wheel) as packed:
        sboms = [name for name in packed.namelist() if ".dist-info/sboms/" in name]
        if [packed.read(name) for name in sboms] != [(source / SBOM).read_bytes()]:
            raise SystemExit(f"{wheel.name} does not contain {SBOM}")
    return wheel


def compare(one: Path, other: Path) -> list[str]:
    """Returns a line for each file that is not the same in both folders."""
    names = sorted({path.name for folder in (one, other) for path in folder.iterdir()})
    lines = []
    for name in names:
        pair = one / name, other / name
        if not all(path.is_file() for path in pair):
            lines.append(f"{name}: is in one build only")
        elif pair[0].read_bytes() != pair[1].read_bytes():
            inside = {entry[0] for entry in _inside(pair[0]) ^ _inside(pair[1])}
            what = ", ".join(sorted(inside)[:20])
            lines.append(f"{name}: {what or 'the same content, packed differently'}")
    return lines


def _inside(file: Path) -> set[tuple[str, object, bytes]]:
    """Returns the files of an archive: name, mode and time, contents."""
    if file.suffix == ".whl":
        with zipfile.ZipFile(file) as packed:
            return {
                (one.filename, (one.date_time, one.external_attr), packed.read(one))
                for one in packed.infolist()
            }
    if ".tar" in file.suffixes:
        with tarfile.open(file) as tar:
            return {
                (one.name, (one.mtime, one.mode, one.uname), stream.read())
                for one in tar
                if (stream := tar.extractfile(one)) is not None
            }
    return {(file.name, None, file.read_bytes())}


def checksums(folder: Path) -> str:
    """Returns what `sha256sum --check` reads."""
    return "".join(
        f"{hashlib.sha256(file.read_bytes()).hexdigest()}  {file.name}\n"
        for file in sorted(folder.iterdir())
    )


if __name__ == "__main__":
    main()
