"""The writers file: tokens that permit writes, and the name of the writer in the audit."""

import hashlib
import json
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from gateway.config import ZenohConfig
from gateway.errors import ConfigError, Damaged
from gateway.northbound import Northbound
from gateway.northbound.interfaces import Place
from gateway.northbound.writers import NotAllowed, Writers
from gateway.tags import Sample, Tag
from tests.northbound.access import PAGE, secret
from tests.northbound.plant import mixer, running
from tests.zenoh_peer import ZenohPeer, free_endpoint

RECIPE = "plant/mixer/recipe/@set"


TOKEN = "Zm9vYmFyYmF6cXV4Zm9vYmFyYmF6cXV4"  # noqa: S105  (of a test)


SALT = "0123456789abcdef"


class RecordedWrites:
    """A history that only records the outcomes of writes."""

    def __init__(self) -> None:
        self.recorded: list[Any] = []

    def samples(self, tag: Tag, time_range: str, limit: int | None, now: int) -> Iterator[Sample]:
        raise NotImplementedError

    def as_recorded(
        self,
        tags: Mapping[str, Tag],
        time_range: str,
        after: Place | None,
        page: int | None,
        now: int,
        pause: Callable[[], None],
    ) -> Iterator[tuple[Sample | Damaged | bool, Place | None]]:
        raise NotImplementedError

    def writes(self, time_range: str, limit: int | None, now: int) -> Iterator[str]:
        raise NotImplementedError

    def record_write(self, time: int, outcome: str) -> None:
        self.recorded.append(json.loads(outcome))


def writers_line(name: str, token: str) -> str:
    return f"{name}:{SALT}:{hashlib.sha256((SALT + token).encode()).hexdigest()}\n"


async def test_only_a_token_of_the_writers_file_writes_and_its_owner_is_named(
    tmp_path: Path,
) -> None:
    file = secret(tmp_path / "writers.txt", "# plant\n\n" + writers_line("alice", TOKEN))
    plant = mixer()
    endpoint = free_endpoint()
    history = RecordedWrites()
    northbound = Northbound(
        ZenohConfig(listen=(endpoint,)),
        "demo",
        plant,
        writers=file,
        history=history,
    )
    async with running(northbound), ZenohPeer("client", connect=[endpoint]) as client:
        audit = await client.subscribe("plant/@gateway/demo/writes")
        for token in (None, b"", b"short", TOKEN[:-1].encode(), b"\xff" * 40, b"x" * 5000):
            [reply] = await client.get(RECIPE, b"7", attachment=token)
            assert reply.json["error"] == "not-allowed"
            assert TOKEN[:-1] not in reply.payload.decode()
            await client.put(RECIPE, b"7", attachment=token)
        [reply] = await client.get(RECIPE, b"8", attachment=TOKEN.encode())
        assert reply.ok
        await client.put(RECIPE, b"9", attachment=TOKEN.encode())
        await audit.until(lambda of: len(of.samples) == 14)
        lines = [sample.json for sample in audit.samples]
        assert {line["outcome"] for line in lines[:12]} == {"not-allowed"}
        assert [(line["value"], line["by"]) for line in lines[12:]] == [(8, "alice"), (9, "alice")]
        assert plant.written == [("mixer/recipe", 8), ("mixer/recipe", 9)]
        assert history.recorded == lines


def test_a_withdrawn_token_or_a_file_readable_by_all_permits_no_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    file = secret(tmp_path / "writers.txt", writers_line("alice", TOKEN))
    writers = Writers(file)
    assert writers.owner(TOKEN.encode()) == "alice"
    file.write_text(writers_line("bob", TOKEN))
    assert writers.owner(TOKEN.encode()) == "alice"  # the file is checked once a second
    clock[0] += 2
    assert writers.owner(TOKEN.encode()) == "bob"
    file.chmod(0o644)
    clock[0] += 2
    with pytest.raises(NotAllowed):
        writers.owner(TOKEN.encode())
    file.chmod(0o600)
    clock[0] += 2
    assert writers.owner(TOKEN.encode()) == "bob"
    file.unlink()
    clock[0] += 2
    with pytest.raises(NotAllowed):
        writers.owner(TOKEN.encode())


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("alice:" + TOKEN, "line 1: write it as name:salt:hash"),
        ("alice:salt:zz", "line 1: write it as name:salt:hash"),
        (writers_line("alice", TOKEN) * 2, "line 2: alice is there twice"),
        ("".join(writers_line(f"w{n}", TOKEN) for n in range(101)), "more than 100"),
    ],
)
def test_a_bad_writers_file_is_a_configuration_error(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says) as raised:
        Writers(secret(tmp_path / "writers.txt", text))
    assert TOKEN not in str(raised.value)


def test_the_command_of_the_page_makes_a_line_and_its_token(tmp_path: Path) -> None:
    (program,) = re.findall(r'^\$ python3 -c "(.*)"$', PAGE.read_text(), re.MULTILINE)
    out = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    token, line = out.stdout.splitlines()
    writers = Writers(secret(tmp_path / "writers.txt", line))
    assert writers.owner(token.removeprefix("token ").encode()) == "alice"
