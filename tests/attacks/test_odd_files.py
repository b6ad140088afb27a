"""The files of a gateway that runs become anything: it goes on with what it has, and says why."""

import asyncio
import os
import signal
import stat
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.attacks.test_security_writers import Writer
from tests.config.test_odd_paths import NO_NAMES
from tests.e2e.processes import Program, free_port, started, vigor_line, write_config
from tests.northbound.access import secret
from tests.zenoh_peer import ZenohPeer, free_endpoint

ALICE = "alice:" + "a" * 40
SPEED, RELOAD = "plant/mixer/speed", "plant/@gateway/demo/reload"
NAMES = [name.replace("\\0", "\0") for name in NO_NAMES]
NO_FILES = ["missing", "loop", "plant.yaml/x", "/dev/zero"]
ODD_PATHS = (("web", "tokens_file", [*NAMES, *NO_FILES]), ("alarms", "path", NAMES))
FILES = ("plant.yaml", "speeds.csv", (TOKENS := "tokens.txt"), (WRITERS := "writers.txt"))
KINDS = ("pipe", "socket", "folder", (LARGE := "700 MB"))
MB = 2**20
RELOADS = 40


def plant(
    folder: Path, web: int, endpoint: str, section: str = "", setting: str = "", name: str = ""
) -> Path:
    """A gateway that reads four files and writes its alarms. `name`: in place of one setting."""
    hall = vigor_line("simulator", {"level": {"address": "D20", "alarm": {"low": 30_000}}})
    hall["devices"]["mixer"]["tags"]["recipe"] = {"address": "D500", "write": True}
    hall["devices"]["mixer"]["tags_from"] = "speeds.csv"
    sections: dict[str, dict[str, Any]] = {
        "web": {"listen": f"127.0.0.1:{web}", "tokens_file": "tokens.txt"},
        "writers": {"file": "writers.txt"},
        "alarms": {"path": "alarms.json"},
    }
    if section:
        sections[section][setting] = name
    sections["defaults"] = {"every": "50ms"}
    return write_config(folder / "plant.yaml", endpoint, {"hall": hall}, **sections)


class Gateway:
    """A gateway that runs, as a client sees it."""

    def __init__(self, program: Program, client: ZenohPeer) -> None:
        self._program = program
        self._client = client
        self._last: Any = None  # the document after a reload

    async def reload(self) -> list[str]:
        """Returns what is wrong with the file; nothing, if it was taken over."""
        last = self._last or await self._client.get_until(RELOAD, bool)
        os.kill(self._program.pid, signal.SIGHUP)
        self._last = await self._client.get_until(RELOAD, lambda one: one != last)
        return [str(sentence) for sentence in self._last["why"]]

    async def goes_on(self) -> None:
        """A gateway that stands still reads no new value."""
        [before] = await self._client.get(SPEED)
        await self._client.get_until(
            SPEED, lambda one: one["quality"] == "good" and one["time"] > before.json["time"]
        )

    @property
    def memory(self) -> int:
        """The most that it has had, in bytes."""
        text = Path(f"/proc/{self._program.pid}/status").read_text()
        return int(text.partition("VmHWM:")[2].split()[0]) * 1024


def make(kind: str, path: Path) -> None:
    match kind:
        case "pipe":
            os.mkfifo(path, 0o600)
        case "socket":
            os.mknod(path, stat.S_IFSOCK | 0o600)
        case "folder":
            path.mkdir()
        case _:
            with secret(path, "").open("wb") as sparse:
                sparse.truncate(700 * MB)


@contextmanager
def coming_and_going(path: Path) -> Iterator[None]:
    ended = threading.Event()

    def run() -> None:
        while not ended.is_set():
            path.touch()
            path.unlink()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


async def test_a_file_that_is_odd_changes_nothing(tmp_path: Path) -> None:
    at = free_port(), (endpoint := free_endpoint())
    secret(tmp_path / TOKENS, "page:" + "t" * 40 + "\n")
    secret(tmp_path / WRITERS, ALICE + "\n")
    (tmp_path / "speeds.csv").write_text("name;address\nspeed;D10\n")
    (tmp_path / "loop").symlink_to("loop")
    with await asyncio.to_thread(started, plant(tmp_path, *at)) as program:
        await asyncio.to_thread(program.says, "device online")
        async with ZenohPeer("client", connect=[endpoint]) as client:
            gateway, alice = Gateway(program, client), Writer(client, ALICE)
            await alice.until("ok")
            for section, setting, names in ODD_PATHS:
                for name in names:
                    plant(tmp_path, *at, section, setting, name)
                    [mistake] = await gateway.reload()
                    assert f"{section}.{setting}" in mistake, name
            plant(tmp_path, *at)
            assert await gateway.reload() == []

            before = gateway.memory
            for name in FILES:
                path = tmp_path / name
                away = path.rename(tmp_path / "away")
                for kind in KINDS:
                    make(kind, path)
                    why = await gateway.reload()
                    # Secrets are read when they are used.
                    assert name in str(why) or (kind == LARGE and name in (TOKENS, WRITERS)), kind
                    await gateway.goes_on()
                    if name == WRITERS:
                        await alice.until("not-allowed")
                    path.rename(tmp_path / f"{kind} {name}")
                away.rename(path)
            await alice.until("ok")
            assert gateway.memory - before < 300 * MB

            # As one that is written anew and renamed, at each change of an alarm.
            with coming_and_going(tmp_path / "alarms.json.bad"):
                for _ in range(RELOADS):
                    assert await gateway.reload() == []
            await gateway.goes_on()
        assert program.end() == 0
        assert not program.has_said("Traceback")
