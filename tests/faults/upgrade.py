"""Upgrades gateways one after the other as `packaging/upgrade.sh` does it over ssh: `make upgrade`.

Each gateway is a machine: a network namespace of its own, or a process where none may be made. The
new version of one of them has a bug: it asks the wrong station, so its PLC does not answer. That
one must be back on the version before, and the others after it untouched.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, NamedTuple

from gateway import __version__
from tests.e2e.processes import (
    PATIENCE,
    ROOT,
    Done,
    Program,
    station,
    until,
    vigor_line,
    write_config,
)
from tests.zenoh_peer import free_endpoint, free_port

OLD, NEW = __version__, "9.0.0"
SCRIPT = ROOT / "packaging" / "upgrade.sh"
_COMMAND = """\
#!/bin/sh
cd "{package}" && exec "{python}" -m gateway "$@"
"""
_RESTART = """\
#!/bin/sh
cd "{folder}"
if [ -f pid ]; then
    kill "$(cat pid)"
    while kill -0 "$(cat pid)" 2>/dev/null; do sleep 0.1; done
fi
opt/current/bin/plc-gateway run "{folder}/plant.yaml" >>log 2>&1 &
echo $! >pid
"""


class Upgraded(NamedTuple):
    """What became of one machine: the exit code, what the script said, what runs there."""

    code: int
    says: str
    runs: str
    seconds: float


class Machine:
    """A gateway with two versions beside each other. `by`: the command that runs others there."""

    def __init__(self, folder: Path, by: tuple[str, ...], *, is_bad: bool) -> None:
        self.folder, self.by = folder, by
        self.plc = free_port()
        folder.mkdir()
        lines = {"hall": vigor_line(f"tcp://127.0.0.1:{self.plc}", {"speed": {"address": "D0"}})}
        self.file = write_config(folder / "plant.yaml", free_endpoint(), lines)
        for version in (OLD, NEW):
            self._install(version)
        if is_bad:
            codec = folder / NEW / "gateway/protocols/vigor/codec.py"
            text = codec.read_text()
            bug = 'b"%02X" % (station + 1)'
            wrong = text.replace('b"%02X" % station', bug)
            assert wrong != text
            codec.write_text(wrong)
        (folder / "opt/current").symlink_to(OLD)
        self.restart = self._script("restart", _RESTART.format(folder=folder))

    def _install(self, version: str) -> None:
        package = self.folder / version
        shutil.copytree(ROOT / "gateway", package / "gateway")
        own = package / "gateway/__init__.py"
        own.write_text(own.read_text().replace(OLD, version))
        home = self.folder / "opt" / version / "bin"
        home.mkdir(parents=True)
        self._script(home / "plc-gateway", _COMMAND.format(package=package, python=sys.executable))

    def _script(self, name: str | Path, text: str) -> Path:
        script = self.folder / name
        script.write_text(text)
        script.chmod(0o755)
        return script

    def _run(self, *command: object, stdin: IO[str] | None = None) -> Done:
        variables = {
            "PLC_GATEWAY_HOME": self.folder / "opt",
            "PLC_GATEWAY_FILE": self.file,
            "PLC_GATEWAY_RESTART": self.restart,
            "PLC_GATEWAY_START": f"{PATIENCE:.0f}",
            "PLC_GATEWAY_WATCH": "5",
        }
        done = subprocess.run(
            [*self.by, *map(str, command)],
            capture_output=True,
            text=True,
            timeout=4 * PATIENCE,
            env={**os.environ, **{name: str(value) for name, value in variables.items()}},
            check=False,
            stdin=stdin,
        )
        return Done(done.returncode, done.stdout, done.stderr)

    @contextmanager
    def runs(self) -> Iterator[Program]:
        """Runs PLC and gateway; the end of the namespace or of this program ends them."""
        with station("tcp", str(self.plc), by=self.by) as plc:
            try:
                self._run(self.restart)
                until(lambda: self.health() != "", "the gateway answers")
                yield plc
            finally:
                os.kill(int((self.folder / "pid").read_text()), 15)

    def health(self) -> str:
        """Returns the sentence of `health --strict`; empty: it is not well."""
        done = self._run(
            self.folder / "opt/current/bin/plc-gateway", "health", self.file, "--strict"
        )
        return done.out.strip() if done.code == 0 else ""

    def upgrade(self) -> Upgraded:
        began = time.monotonic()
        with SCRIPT.open() as script:
            done = self._run("sh", "-s", NEW, "hall", stdin=script)
        took = time.monotonic() - began
        return Upgraded(done.code, done.out + done.err, self.health(), took)


@contextmanager
def machines(folder: Path, count: int, bad: int) -> Iterator[list[Machine]]:
    """Yields running machines; `bad` is the number of the one whose new version has the bug."""
    with ExitStack() as stack:
        found = []
        for number in range(count):
            by = stack.enter_context(_namespace(f"up{os.getpid()}-{number}"))
            machine = Machine(folder / f"gw-{number}", by, is_bad=number == bad)
            stack.enter_context(machine.runs())
            found.append(machine)
        yield found


@contextmanager
def _namespace(name: str) -> Iterator[tuple[str, ...]]:
    """Yields the command that runs others in a network of its own; empty: none may be made."""
    ip = shutil.which("ip") or "/usr/sbin/ip"
    made = (
        Path(ip).exists()
        and not subprocess.run(
            [ip, "netns", "add", name], capture_output=True, check=False
        ).returncode
    )
    if not made:
        yield ()
        return
    try:
        subprocess.run([ip, "-n", name, "link", "set", "lo", "up"], check=True)
        yield (ip, "netns", "exec", name)
    finally:
        subprocess.run([ip, "netns", "del", name], check=True)


def upgraded(fleet: list[Machine]) -> Iterator[Upgraded]:
    """Upgrades one after the other, until one is not upgraded."""
    for machine in fleet:
        found = machine.upgrade()
        yield found
        if found.code:
            return


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--gateways", type=int, default=10)
    given = parser.parse_args()
    bad = given.gateways * 7 // 10
    with (
        tempfile.TemporaryDirectory() as folder,
        machines(Path(folder), given.gateways, bad) as fleet,
    ):
        where = "network namespaces" if fleet[0].by else "processes: no namespace may be made here"
        print(f"{given.gateways} gateways in {where}; the new version of number {bad} has a bug")
        for number, one in enumerate(upgraded(fleet)):
            print(f"{number}: exit code {one.code}, {one.seconds:.0f} s: {one.says.strip()}")
        for number, machine in enumerate(fleet):
            print(f"{number}: {machine.health()}")


if __name__ == "__main__":
    main()
