"""Starts programs as processes, reads their output, and ends them by their ids."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, NamedTuple, Self

from tests.e2e.forking import ENVIRONMENT, MODULES, Forked
from tests.zenoh_peer import free_port as free_port

PATIENCE = 300.0  # seconds; never waited for when all is well
ROOT = Path(__file__).parents[2]
GATEWAY = sys.executable, "-m", "gateway"
forks = False  # not where what programs take is measured: benchmarks

# Shells start what runs in the background deaf to Ctrl-C, and children inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def slowed(seconds: float) -> float:
    """Returns the time that this machine, busy as it is now, takes for that of an idle one."""
    return seconds * (1 + os.getloadavg()[0] / (os.cpu_count() or 1))


class Done(NamedTuple):
    """The result of a program that ended by itself."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """The document that it printed."""
        assert self.out, self
        return json.loads(self.out)


def plc_gateway(*arguments: object, **how: Any) -> Done:
    """Runs a command to its end. `cwd`; `env`: variables besides those of this process."""
    cwd, env = how.pop("cwd", ROOT), ENVIRONMENT | how.pop("env", {})
    with TemporaryFile("w+") as out, TemporaryFile("w+") as err, Path(os.devnull).open() as nothing:
        ends = [one.fileno() for one in (nothing, out, err)]
        process = _begun([*GATEWAY, *map(str, arguments)], cwd, env, ends)
        try:
            code = process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            raise
        for one in (out, err):
            one.seek(0)
        done = Done(code, out.read(), err.read())
    assert "Traceback" not in done.err, done.err
    return done


def until_exit(code: int, run: Callable[..., Done], *arguments: object) -> Done:
    """Runs a command until it ends with this code: a gateway may start, and have no values yet."""
    last: list[Done] = []

    def ends() -> bool:
        last[:] = [run(*arguments)]
        return last[0].code == code

    until(ends, f"{arguments} ends with {code}")
    return last[0]


class Program:
    """A running program. Its output is kept; pytest shows it when the test fails."""

    def __init__(self, *command: object, merged: bool = True) -> None:
        """`merged`: its errors are among its lines; otherwise they are in `errors`."""
        self.lines: list[str] = []
        self.errors: list[str] = []
        self._name = " ".join(map(str, command))[-100:]
        self._news = threading.Condition()
        (its_input, writes), (reads, its_output) = os.pipe(), os.pipe()
        streams = [(self.lines, reads)]
        its_errors = its_output
        if not merged:
            reads, its_errors = os.pipe()
            streams.append((self.errors, reads))
        ends = its_input, its_output, its_errors
        self._process = _begun(list(map(str, command)), ROOT, ENVIRONMENT, ends)
        for end in set(ends):
            os.close(end)
        self._input = os.fdopen(writes, "w", buffering=1)
        self._readers = [threading.Thread(target=self._read, args=one) for one in streams]
        for reader in self._readers:
            reader.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        if self._process.poll() is None:
            self._process.kill()
        self._finish()
        print(f"--- {self._name} ended with {self._process.returncode}, having said:")
        print("\n".join(line for line in [*self.lines, *self.errors] if line[:3] != "ok "))

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    def says(self, *words: str, after: int = 0) -> str:
        """Returns the first line with all the words after so many lines; waits for it."""
        return self._wait(words, after)

    def _wait(self, words: tuple[str, ...], first: int, timeout: float = PATIENCE) -> str:
        until = time.monotonic() + timeout
        with self._news:
            while True:
                for line in self.lines[first:]:
                    if all(word in line for word in words):
                        return line
                left = until - time.monotonic()
                ended = not any(reader.is_alive() for reader in self._readers)
                if left <= 0 or ended or not self._news.wait(left):
                    said = "\n".join(self.lines)
                    raise AssertionError(f"{self._name} did not say {words}, but:\n{said}")

    def has_said(self, *words: str) -> bool:
        return any(all(word in line for word in words) for line in self.lines)

    def tell(self, command: str) -> str:
        """Writes a line to its standard input. Returns the text that it prints after `ok`."""
        first = len(self.lines)
        self._input.write(command + "\n")
        return self._wait(("ok",), first).removeprefix("ok").strip()

    def end(self, by: signal.Signals = signal.SIGTERM, within: float = PATIENCE) -> int:
        """Sends a signal and waits. Returns the exit code, negative where the signal ended it."""
        self._process.send_signal(by)
        return self.ended(within)

    def ended(self, within: float = PATIENCE) -> int:
        """Waits for its end."""
        code = self._process.wait(within)
        self._finish()
        return code

    def _finish(self) -> None:
        self._process.wait(PATIENCE)
        for reader in self._readers:
            reader.join(PATIENCE)
        with suppress(BrokenPipeError):
            self._input.close()

    def _read(self, lines: list[str], reads: int) -> None:
        with os.fdopen(reads) as stream:
            for line in stream:
                with self._news:
                    lines.append(line.rstrip("\n"))
                    self._news.notify_all()
        with self._news:
            self._news.notify_all()


def _begun(
    words: list[str], cwd: Path, env: dict[str, str], ends: Sequence[int]
) -> subprocess.Popen[bytes] | Forked:
    """`ends`: descriptors of its standard input, output and errors."""
    if forks and words[:2] == [sys.executable, "-m"] and words[2] in MODULES:
        return Forked(words[2:], cwd, env, ends)
    stdin, stdout, stderr = ends
    return subprocess.Popen(words, stdin=stdin, stdout=stdout, stderr=stderr, cwd=cwd, env=env)


def gateway(*arguments: object, merged: bool = True, variables: Sequence[str] = ()) -> Program:
    """Starts `plc-gateway …` as a process; for `run` wait with `.says("Zenoh session ready")`.

    `variables`: of its environment, besides those of this process, as `NAME=value`.
    """
    by = ("env", *variables) if variables else ()
    return Program(*by, *GATEWAY, *arguments, merged=merged)


def started(config: Path, *options: str) -> Program:
    """Starts a gateway and waits for its Zenoh session."""
    return _ready(gateway("run", config, *options), "Zenoh session ready")


def station(*where: str, stations: tuple[int, ...] = (1,), by: tuple[str, ...] = ()) -> Program:
    """Starts simulated Vigor PLCs that take commands (tests/e2e/station.py).

    `by`: the command that runs them, such as `ip netns exec plc`.
    """
    program = (*by, sys.executable, "-m", "tests.e2e.station")
    return _ready(Program(*program, ",".join(map(str, stations)), *where), "ready")


def cable(socat: str, link: Path, far_end: str) -> Program:
    """Starts socat as a cable from a pty at `link` to `far_end`. Killing it unplugs the cable."""
    ends = f"pty,raw,echo=0,link={link}", far_end
    return _ready(Program(socat, "-d", "-d", *ends), "starting data transfer loop")


def _ready(program: Program, words: str) -> Program:
    """Waits for the words and returns the program; ends it if they do not come."""
    try:
        program.says(words)
    except BaseException:
        program.__exit__()
        raise
    return program


def device_server(ser2net: str, folder: Path, tty: Path, number: int) -> Program:
    """Starts ser2net, telnet with RFC 2217, on a TCP port in front of a serial port."""
    config = folder / "ser2net.yaml"
    config.write_text(
        "connection: &a\n"
        f"  accepter: telnet(rfc2217),tcp,127.0.0.1,{number}\n"
        f"  connector: serialdev,{tty},9600n81,local\n"
    )
    program = Program(ser2net, "-n", "-u", "-c", config, "-P", folder / "ser2net.pid")
    until(lambda: listens(number), "ser2net listens")  # it does not say so itself
    return program


@contextmanager
def held(pid: int) -> Iterator[None]:
    """Holds a process, as a hypervisor or a debugger does: all its threads stand still."""
    os.kill(pid, signal.SIGSTOP)
    try:
        until(lambda: _states(pid) == {"T"}, "every thread stands still")
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


def _states(pid: int) -> set[str]:
    threads = Path(f"/proc/{pid}/task").glob("*/stat")
    return {one.read_text().rpartition(")")[2].split()[0] for one in threads}


def listens(number: int) -> bool:
    """A process listens there; found without a connection, as a port may serve one at a time."""
    return f"0100007F:{number:04X} 00000000:0000 0A" in Path("/proc/net/tcp").read_text()


def until(happened: Callable[[], bool], what: str) -> None:
    """Polls a condition of the system, which sends no notice."""
    end = time.monotonic() + PATIENCE
    while not happened():
        assert time.monotonic() < end, f"it did not happen that {what}"
        time.sleep(0.01)


def write_config(path: Path, endpoint: str, lines: dict[str, Any], **sections: Any) -> Path:
    """Writes a configuration file (JSON is YAML)."""
    document = {
        "gateway": {"name": "demo"},
        "zenoh": {"prefix": "plant", "listen": [endpoint]},
        "defaults": {"every": "200ms"},
        **sections,
        "lines": lines,
    }
    path.write_text(json.dumps(document))
    return path


def vigor_line(port: str, tags: dict[str, Any], **device: Any) -> dict[str, Any]:
    """Returns a line at 19200 7E1 with the PLC `mixer`, station 1, reply time-out 200 ms."""
    settings = {"protocol": "vigor", "station": 1, "reply_timeout": "200ms", **device}
    return {
        "port": port,
        "baudrate": 19200,
        "format": "7E1",
        "devices": {"mixer": {**settings, "tags": tags}},
    }
