"""The files of many gateways in a folder, such as a clone of a git repository.

As a program, `python -m gateway.contract.fleet_files FOLDER`, it prints `wanted_in` as JSON: a
gateway compares its fleet with files, and has no time of its own to read a thousand of them.
"""

import json
import os
import resource
import stat
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from gateway.config import ConfigErrors, load
from gateway.config.yaml.file import TEXTS, read_yaml

MOST_FILES = 10_000
MOST_NAMES = 200_000  # of files and folders that are looked at
_OWN = {"gateway", "lines"}  # sections: one of them is in each file of a gateway
_MOST_MEMORY = 2 * 2**30  # bytes
_LESS_IMPORTANT = 10  # than other programs of the machine


class Wanted(NamedTuple):
    """A gateway as a file wants it."""

    file: Path
    digest: str


def wanted_in(folder: Path) -> tuple[dict[str, Wanted], list[str]]:
    """Returns the gateways of the files in a folder and below, and the mistakes in them.

    Templates, files of other programs and all that is hidden are left out. Links to folders are not
    followed.
    """
    found, mistakes = dict[str, Wanted](), list[str]()
    files = sorted(file for file in names_in(folder, mistakes) if file.suffix in (".yaml", ".yml"))
    for file in files[:MOST_FILES]:
        try:
            config = load(file, elsewhere=True)
        except ConfigErrors as error:
            if not _is_of_another_program(file):
                mistakes.append(str(error).splitlines()[0])
            continue
        gateway = f"{config.zenoh.prefix}/{config.name}"
        if gateway in found:
            other = found[gateway].file
            mistakes.append(f"{file}: {gateway} is the gateway of {other} too: only one can run")
            continue
        found[gateway] = Wanted(file, config.digest)
    if len(files) > MOST_FILES:
        mistakes.append(f"{folder} has {len(files)} files: only {MOST_FILES} were read")
    return found, mistakes


def names_in(folder: Path, mistakes: list[str]) -> Iterator[Path]:
    """Yields all files in a folder and below that are not hidden. Notes a folder that cannot be
    read: the files of its gateways would be missing in silence."""
    count = 0

    def refused(error: OSError) -> None:
        mistakes.append(f"{error.filename}: {error.strerror}: its files are not compared")

    for place, folders, names in os.walk(folder, onerror=refused):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        count += len(folders) + len(names)
        if count > MOST_NAMES:
            mistakes.append(f"{folder} has more than {MOST_NAMES} names: not all were read")
            return
        yield from (Path(place, name) for name in names if not name.startswith("."))


def state_of(folder: Path) -> int:
    """Returns another number after each change of a file below the folder. Blocks."""
    states = []
    for file in names_in(folder, []):
        try:
            found = file.stat()
        except OSError:
            continue
        if stat.S_ISREG(found.st_mode):
            states.append((str(file), found.st_mtime_ns, found.st_size, found.st_ino))
    return hash(tuple(sorted(states)))


def _is_of_another_program(file: Path) -> bool:
    try:
        found, _ = read_yaml(file, TEXTS)
    except ConfigErrors:
        return False
    return bool(found.data) and not found.data.keys() & _OWN


def main() -> None:
    os.nice(_LESS_IMPORTANT)
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    most = _MOST_MEMORY if hard == resource.RLIM_INFINITY else min(hard, _MOST_MEMORY)
    resource.setrlimit(resource.RLIMIT_AS, (most, hard))
    wanted, mistakes = wanted_in(Path(sys.argv[1]))
    found = {gateway: (str(one.file), one.digest) for gateway, one in wanted.items()}
    print(json.dumps([found, mistakes]))


if __name__ == "__main__":
    main()
