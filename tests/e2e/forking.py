"""Starts `python -m gateway` as a fork of a process that has imported it.

The imports take most of the CPU time of a short program, and the tests start hundreds. The process
that forks has one thread and ran nothing: a fork goes on as every program does after its imports.
What a program reads before them, such as `PYTHONUTF8` or the locale, needs `subprocess`.
"""

import atexit
import gc
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import import_module
from pathlib import Path
from runpy import run_module
from typing import Any, NoReturn

_LONGEST = 1 << 17  # bytes of a request
_IMPORTED = (
    "gateway.cli.main",
    "gateway.cli.run",
    "gateway.simulator.serve",
    "uvloop",
    "zenoh.ext",
)
MODULES = "gateway", "tests.e2e.station"
ENVIRONMENT = {**os.environ, "PYTHONUNBUFFERED": "1", "NO_COLOR": "1", "COLUMNS": "120"}


class Forked:
    """A running program: as much of `subprocess.Popen` as tests use."""

    def __init__(
        self, words: Sequence[str], cwd: Path, env: Mapping[str, str], ends: Sequence[int]
    ) -> None:
        """`words`: a module of `MODULES` and its arguments. `ends`: descriptors of its standard
        input, output and errors."""
        request = {"words": words, "cwd": str(cwd), "env": dict(env)}
        self._parent = _forker()
        self.pid: int = self._parent.ask(request, ends)
        self.returncode: int | None = None
        self._one_asks = threading.Lock()

    def poll(self) -> int | None:
        with self._one_asks:
            if self.returncode is None:
                self.returncode = self._parent.ask(self.pid)
            return self.returncode

    def wait(self, timeout: float) -> int:
        end = time.monotonic() + timeout
        while (code := self.poll()) is None:
            if time.monotonic() > end:
                raise subprocess.TimeoutExpired(str(self.pid), timeout)
            time.sleep(0.01)
        return code

    def send_signal(self, by: signal.Signals) -> None:
        if self.poll() is None:
            os.kill(self.pid, by)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


class _Forker:
    """The test's side of the process that forks."""

    def __init__(self) -> None:
        self._control, its = socket.socketpair(type=socket.SOCK_SEQPACKET)
        self._one_asks = threading.Lock()
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__, str(its.fileno())],
            stdin=subprocess.PIPE,  # streams that do not seek, as those of the forks
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            pass_fds=[its.fileno()],
            cwd=Path(__file__).parents[2],
            env=ENVIRONMENT,
        )
        its.close()
        atexit.register(self._end)

    def ask(self, request: object, ends: Sequence[int] = ()) -> Any:
        with self._one_asks:
            socket.send_fds(self._control, [json.dumps(request).encode()], ends)
            return json.loads(self._control.recv(_LONGEST) or self._failed())

    def _failed(self) -> NoReturn:
        _, said = self._process.communicate()
        raise AssertionError(said.decode())

    def _end(self) -> None:
        self._control.close()
        self._process.communicate()


@cache
def _forker() -> _Forker:
    return _Forker()


def _serve(control: socket.socket) -> str | None:
    """Forks for each request. Returns None at the end; in each fork, the module that it runs."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    while True:
        text, ends, _, _ = socket.recv_fds(control, _LONGEST, 3)
        if not text:
            return None
        match json.loads(text):
            case int(forked):
                ended, status = os.waitpid(forked, os.WNOHANG)
                code = os.waitstatus_to_exitcode(status) if ended else None
                control.send(json.dumps(code).encode())
            case request:
                if (pid := os.fork()) == 0:
                    control.close()
                    return _become(request, ends)
                for end in ends:
                    os.close(end)
                control.send(b"%d" % pid)


def _become(request: dict[str, Any], ends: Sequence[int]) -> str:
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number, end in enumerate(ends):
        os.dup2(end, number)
        os.close(end)
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["env"])
    module, *sys.argv[1:] = request["words"]
    return str(module)


if __name__ == "__main__":
    os.environ["PYDANTIC_DISABLE_PLUGINS"] = "__all__"  # as `main` sets it
    for name in _IMPORTED:
        import_module(name)
    gc.collect()
    gc.freeze()
    if module := _serve(socket.socket(fileno=int(sys.argv[1]))):
        run_module(module, run_name="__main__", alter_sys=True)
