"""Another file over Zenoh: checked, loaded, and confirmed or put back."""

import asyncio
import json
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from pathlib import Path
from typing import Any, TypeVar

import orjson
import pytest

from gateway.config import Config, ConfigErrors, load
from gateway.config.changes import needs_restart
from gateway.engine.forecast import LineForecast
from gateway.errors import BadValue, Busy, GatewayError, NotAllowed, Unknown
from gateway.parts.remote import part as module
from gateway.parts.remote.part import RemotePart
from gateway.parts.remote.settings import RemoteSection
from gateway.plant.expected import polls_of

T = TypeVar("T")
Virtual = Callable[[Coroutine[Any, Any, Any]], Any]
HOUR = 3600.0
FILE = """\
gateway: {{name: demo}}
writers: {{file: writers.txt}}
remote: {{writers: [ana], confirm: 10min, keep: 2}}
zenoh: {{listen: [tcp/127.0.0.1:7447]}}
lines:
  hall:
    port: /dev/ttyS0
    devices: {{mixer: {{protocol: vigor, station: 1, tags: {{speed: {{address: {address}}}}}}}}}
"""


@pytest.fixture(autouse=True)
def _without_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    async def at_once(function: Callable[..., T], *arguments: object, within: float) -> T:
        return function(*arguments)

    monkeypatch.setattr(module, "off_loop", at_once)


class Gateway:
    """A configuration file that is reloaded as the service does it, and its part."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "plant.yaml"
        (folder / "writers.txt").write_text(f"ana:{'0' * 32}\n")
        (folder / "writers.txt").chmod(0o600)
        self.path.write_text(FILE.format(address="D0"))
        self.current = load(self.path)
        self.refuses: Sequence[str] = ()
        self.loaded = [self.current.digest]
        self.audited: list[str] = []
        self.started = asyncio.get_running_loop().time()
        self.plant = self.others = self

    def wall(self) -> int:
        now = asyncio.get_running_loop().time() - self.started
        return 1_790_000_000_000_000_000 + round(now * 1e9)

    def audit(self, _at: int, event: str) -> None:
        self.audited.append(json.loads(event)["answer"])

    def forecasts(self, config: Config) -> Sequence[LineForecast]:
        return polls_of(config)

    async def reload(self) -> Sequence[str]:
        if self.refuses:
            return self.refuses
        try:
            found = load(self.path)
        except ConfigErrors as error:
            return str(error).splitlines()
        self.current = found
        self.loaded.append(found.digest)
        return ()

    async def part(self, *, active: bool = True) -> RemotePart:
        """As the part begins, also after a restart."""
        core: Any = self
        settings = self.current.part(RemoteSection)
        assert settings is not None
        part = RemotePart(core, settings, self)
        await part.restore()
        if active:
            part.activate()
        return part


def file(address: str, **replaced: str) -> str:
    text = FILE.format(address=address)
    for old, new in replaced.items():
        text = text.replace(old, new)
    return text


async def ask(part: RemotePart, do: str, by: str | None = "ana", **more: Any) -> dict[str, Any]:
    answer = await part.order("file", orjson.dumps({"do": do, **more}), by)
    found: dict[str, Any] = orjson.loads(answer)
    return found


async def beside(part: RemotePart, work: Awaitable[T]) -> T:
    """Does the work while the part runs."""
    running = asyncio.create_task(part.run())
    try:
        return await work
    finally:
        running.cancel()


def test_a_file_that_somebody_confirms_stays(run_virtual: Virtual, tmp_path: Path) -> None:
    async def whole() -> None:
        gateway = Gateway(tmp_path)
        part = await gateway.part()

        async def work() -> None:
            found = await ask(part, "apply", file=file("D1"))
            assert (found["state"], found["by"], found["earlier"]) == (
                *("waiting", "ana"),
                [gateway.loaded[0]],
            )
            assert gateway.current.digest == found["digest"] != found["before"]
            with pytest.raises(Busy, match="waits for confirmation until"):
                await ask(part, "apply", file=file("D2"))
            with pytest.raises(BadValue, match=f"the file that waits is {found['digest']}"):
                await ask(part, "confirm", digest=found["before"])
            assert (await ask(part, "confirm", digest=found["digest"]))["state"] == "confirmed"
            await asyncio.sleep(HOUR)
            assert gateway.loaded == [found["before"], found["digest"]]
            again = await ask(part, "rollback", digest=found["before"])
            assert again["digest"] == found["before"]
            assert "D0" in gateway.path.read_text()

        await beside(part, work())
        assert gateway.audited == ["waiting", "confirmed by ana", "waiting"]

    run_virtual(whole())


@pytest.mark.parametrize("restart", [False, True])
def test_a_file_that_nobody_confirms_goes_back(
    run_virtual: Virtual, tmp_path: Path, restart: bool
) -> None:
    async def whole() -> None:
        gateway = Gateway(tmp_path)
        part = await gateway.part()
        await ask(part, "apply", file=file("D1"), confirm=60)
        if restart:  # the process ended before its time was over
            part = await gateway.part()
        await beside(part, asyncio.sleep(59))
        assert "D1" in gateway.path.read_text()
        await beside(part, asyncio.sleep(2))
        assert "D0" in gateway.path.read_text()
        assert gateway.current.digest == gateway.loaded[0]
        assert part.document()["state"] == "reverted"
        assert "nobody confirmed" in part.document()["why"]

    run_virtual(whole())


def test_each_change_has_its_own_time(run_virtual: Virtual, tmp_path: Path) -> None:
    """One that was confirmed at once delays the way back of the next one by nothing."""

    async def whole() -> None:
        gateway = Gateway(tmp_path)
        part = await gateway.part()

        async def work() -> None:
            found = await ask(part, "apply", file=file("D1"), confirm=HOUR)
            await asyncio.sleep(1)
            await ask(part, "confirm", digest=found["digest"])
            await ask(part, "apply", file=file("D2"), confirm=60)
            await asyncio.sleep(59)
            assert part.document()["state"] == "waiting"
            await asyncio.sleep(2)
            assert (part.document()["state"], gateway.current.digest) == (
                "reverted",
                found["digest"],
            )

        await beside(part, work())

    run_virtual(whole())


def test_after_a_crash_in_the_middle_the_file_before_counts(
    run_virtual: Virtual, tmp_path: Path
) -> None:
    async def whole() -> None:
        gateway = Gateway(tmp_path)
        part = await gateway.part()
        await ask(part, "apply", file=file("D1"))
        gateway.path.write_text(file("D0"))  # the note was on disk, and not yet the file
        part = await gateway.part()
        await beside(part, asyncio.sleep(HOUR))
        assert (part.document()["state"], gateway.current.digest) == ("reverted", gateway.loaded[0])

    run_virtual(whole())


def test_a_file_that_a_person_changed_meanwhile_is_left_alone(
    run_virtual: Virtual, tmp_path: Path
) -> None:
    async def whole() -> None:
        gateway = Gateway(tmp_path)
        part = await gateway.part()
        gateway.path.write_text(file("D7"))
        with pytest.raises(BadValue, match="a person works on it"):
            await ask(part, "apply", file=file("D1"))
        gateway.path.write_text(file("D0"))
        await ask(part, "apply", file=file("D1"))
        gateway.path.write_text(file("D8"))
        await beside(part, asyncio.sleep(HOUR))
        assert part.document()["state"] == "failed"
        assert "was left alone" in part.document()["why"]
        assert "D8" in gateway.path.read_text()

    run_virtual(whole())


def test_a_file_that_the_reload_refuses_goes_back_at_once(
    run_virtual: Virtual, tmp_path: Path
) -> None:
    async def whole() -> None:
        gateway = Gateway(tmp_path)
        part = await gateway.part()

        async def refuse_once() -> Sequence[str]:
            del gateway.reload
            return ["device mixer belongs to gateway other"]

        gateway.reload = refuse_once  # type: ignore[method-assign]
        with pytest.raises(BadValue, match="belongs to gateway other"):
            await ask(part, "apply", file=file("D1"))
        assert "D0" in gateway.path.read_text()
        assert part.document()["state"] == "reverted"

    run_virtual(whole())


HEAVY = file("D1", **{"lines:": "defaults: {every: 1ms}\nlines:"})
WRONG: list[tuple[dict[str, Any], type[GatewayError], str]] = [
    ({"do": "apply", "file": "lines: ["}, BadValue, r"plant\.yaml:2: no YAML"),
    ({"do": "apply", "file": file("Q1")}, BadValue, "Q1"),
    ({"do": "apply", "file": file("D0")}, BadValue, "runs a file with these settings already"),
    ({"do": "apply", "file": file("D1", **{"7447": "7448"})}, BadValue, "zenoh.listen changed"),
    ({"do": "apply", "file": file("D1", **{"[ana]": "[bob]"})}, BadValue, "remote.writers changed"),
    ({"do": "apply", "file": file("D1", **{"name: demo": "name: b"})}, BadValue, "gateway.name"),
    ({"do": "apply", "file": HEAVY}, BadValue, "line hall is asked for .* multiply the intervals"),
    ({"do": "check", "file": HEAVY}, BadValue, "line hall is asked for"),
    ({"do": "apply", "file": 7}, BadValue, "needs a text in `file`"),
    ({"do": "apply"}, BadValue, "needs a text in `file`"),
    ({"do": "apply", "file": file("D1"), "confirm": 1}, BadValue, "no number from 10 to 86400"),
    ({"do": "apply", "file": file("D1"), "confirm": True}, BadValue, "no number from 10 to 86400"),
    ({"do": "apply", "file": file("D1"), "now": 1}, BadValue, "its fields are"),
    ({"do": "confirm", "digest": "x"}, BadValue, "no file waits"),
    ({"do": "revert"}, BadValue, "no file waits"),
    ({"do": "rollback", "digest": "x"}, Unknown, "no earlier file x"),
    ({"do": "erase"}, BadValue, "do is none of"),
    ({"do": "apply", "patch": {}}, BadValue, "runs a file with these settings already"),
    ({"do": "apply", "patch": []}, BadValue, "`patch` is settings"),
    ({"do": "apply", "patch": {}, "file": "x"}, BadValue, "`patch` is settings"),
    ({"do": "rollback", "patch": {}, "digest": "x"}, BadValue, "`patch` is settings"),
    ({"do": "apply", "patch": {"lines": {"hall": {"port": 7}}}}, BadValue, r"plant\.yaml:\d+: "),
    ({"do": "check", "patch": {"remote": {"writers": ["b"]}}}, BadValue, "remote.writers changed"),
    ({"do": "apply", "patch": {"writers": None}}, BadValue, "it needs writers"),
    ({"do": "apply", "file": file("D1"), "digest": "x"}, BadValue, "here the file is .*, not x"),
    ({"do": None}, BadValue, "do is none of"),
]


def test_what_is_refused_changes_nothing(run_virtual: Virtual, tmp_path: Path) -> None:
    async def whole() -> None:
        gateway = Gateway(tmp_path)
        part = await gateway.part()
        for order, error, says in WRONG:
            with pytest.raises(error, match=says):
                await part.order("file", orjson.dumps(order), "ana")
        with pytest.raises(BadValue, match="no JSON"):
            await part.order("file", b"\xff", "ana")
        with pytest.raises(Unknown):
            await part.order("other", b"{}", "ana")
        for by in ("bob", None):
            with pytest.raises(NotAllowed):
                await ask(part, "apply", by, file=file("D1"))
        waiting = await gateway.part(active=False)
        with pytest.raises(Busy, match="stands by"):
            await ask(waiting, "apply", file=file("D1"))
        assert (await ask(part, "check", file=file("D1")))["state"] == "none"
        assert gateway.path.read_text() == file("D0")
        assert gateway.loaded == [gateway.current.digest]

    run_virtual(whole())


def test_a_patch_changes_a_device_and_goes_back_with_all_comments(
    run_virtual: Virtual, tmp_path: Path
) -> None:
    async def whole() -> None:
        gateway = Gateway(tmp_path)
        gateway.path.write_text(before := f"# The hall\n{file('D0')}")
        part = await gateway.part()
        pump = {"use": "pump", "base": 7, "station": 2}
        template = {"parameters": ["base"], "tags": {"flow": {"address": "D{base}"}}}
        more = {
            "lines": {"hall": {"devices": {"mixer": None, "pump": {"protocol": "vigor", **pump}}}}
        }
        await ask(part, "apply", patch={"templates": {"pump": template}, **more})
        [device] = gateway.current.devices
        assert [tag.text for tag in device.tags] == ["D7"]
        await ask(part, "revert")
        assert gateway.path.read_text() == before

    run_virtual(whole())


def test_a_line_that_is_overloaded_already_may_become_lighter(
    run_virtual: Virtual, tmp_path: Path
) -> None:
    async def whole() -> None:
        gateway = Gateway(tmp_path)
        gateway.path.write_text(HEAVY)
        gateway.current = load(gateway.path)
        part = await gateway.part()
        lighter = HEAVY.replace("1ms", "2ms")
        await ask(part, "apply", file=lighter)
        await ask(part, "revert")
        with pytest.raises(BadValue, match="is asked for"):
            await ask(part, "apply", file=HEAVY.replace("D1", "D1}, more: {address: D900"))

    run_virtual(whole())


def test_only_so_many_earlier_files_are_kept(run_virtual: Virtual, tmp_path: Path) -> None:
    async def whole() -> None:
        gateway = Gateway(tmp_path)
        part = await gateway.part()
        for number in range(1, 6):
            found = await ask(part, "apply", file=file(f"D{number}"))
            await ask(part, "confirm", digest=found["digest"])
            await asyncio.sleep(1)
        assert part.document()["earlier"] == gateway.loaded[3:5]
        assert len([*tmp_path.glob("plant.yaml.kept/*")]) == 2

    run_virtual(whole())


def test_a_clock_that_was_set_back_costs_no_way_back(run_virtual: Virtual, tmp_path: Path) -> None:
    """The copies of the year before are not newer: the last one is the way back."""

    async def whole() -> None:
        gateway = Gateway(tmp_path)
        part = await gateway.part()
        for number in (1, 2):
            found = await ask(part, "apply", file=file(f"D{number}"))
            await ask(part, "confirm", digest=found["digest"])
            await asyncio.sleep(1)
        gateway.started += 1e6  # the clock
        (tmp_path / "plant.yaml.kept" / "notes-of-ana.yaml").write_text("x")
        await ask(part, "apply", file=file("D3"), confirm=60)
        await beside(part, asyncio.sleep(61))
        assert "D2" in gateway.path.read_text()
        assert part.document()["state"] == "reverted"

    run_virtual(whole())


def test_a_file_that_a_person_has_replaced_is_not_confirmed(
    run_virtual: Virtual, tmp_path: Path
) -> None:
    async def whole() -> None:
        gateway = Gateway(tmp_path)
        part = await gateway.part()
        found = await ask(part, "apply", file=file("D1"))
        gateway.path.write_text(file("D5"))
        await gateway.reload()
        with pytest.raises(BadValue, match="meanwhile a person had the gateway load"):
            await ask(part, "confirm", digest=found["digest"])
        assert part.document()["state"] == "waiting"

    run_virtual(whole())


def test_a_disk_that_does_not_read_forgets_no_change(run_virtual: Virtual, tmp_path: Path) -> None:
    async def whole() -> None:
        gateway = Gateway(tmp_path)
        part = await gateway.part()
        await ask(part, "apply", file=file("D1"), confirm=60)
        state = tmp_path / "remote.json"
        kept = state.read_bytes()
        state.unlink()
        state.mkdir()  # as if the disk refused it
        with pytest.raises(GatewayError, match=r"remote\.json cannot be read"):
            await gateway.part()
        state.rmdir()
        state.write_bytes(kept)
        await beside(await gateway.part(), asyncio.sleep(61))
        assert "D0" in gateway.path.read_text()

    run_virtual(whole())


def test_a_link_stays_a_link(run_virtual: Virtual, tmp_path: Path) -> None:
    async def whole() -> None:
        gateway = Gateway(tmp_path)
        real = tmp_path / "repository" / "a.yaml"
        real.parent.mkdir()
        gateway.path.rename(real)
        gateway.path.symlink_to(real)
        part = await gateway.part()
        await ask(part, "apply", file=file("D1"))
        assert gateway.path.is_symlink()
        assert "D1" in real.read_text()

    run_virtual(whole())


def test_a_folder_that_takes_no_file(run_virtual: Virtual, tmp_path: Path) -> None:
    async def whole() -> None:
        gateway = Gateway(tmp_path)
        part = await gateway.part()
        (tmp_path / "plant.yaml.new").mkdir()  # as if the disk refused it
        with pytest.raises(GatewayError, match=r"plant\.yaml\.new: "):
            await ask(part, "apply", file=file("D1"))
        assert gateway.path.read_text() == file("D0")
        assert (part.document()["state"], gateway.loaded) == ("reverted", gateway.loaded[:1])

    run_virtual(whole())


def test_the_section_needs_writers(tmp_path: Path) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text(file("D0", **{"writers: {file: writers.txt}\n": ""}))
    with pytest.raises(ConfigErrors, match=r"remote\.writers: it needs writers"):
        load(path)


def test_what_a_person_beside_the_gateway_must_do(tmp_path: Path) -> None:
    """Whatever decides who may connect, write or send a file needs a restart."""
    gateway_file, changed = tmp_path / "a.yaml", tmp_path / "b.yaml"
    (tmp_path / "writers.txt").write_text(f"ana:{'0' * 32}\n")
    (tmp_path / "writers.txt").chmod(0o600)
    gateway_file.write_text(file("D0"))
    for section in (
        "web: {listen: '0.0.0.0:8080', tokens_file: writers.txt}",
        "history: {path: /tmp/elsewhere.db}",
        "notify: {command: [/bin/sh], rules: [{to: [command]}]}",
    ):
        changed.write_text(file("D0") + section + "\n")
        assert needs_restart(load(gateway_file), load(changed)), section
