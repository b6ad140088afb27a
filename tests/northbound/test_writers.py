"""The writers file: signatures that permit writes, and the name of the writer in the audit."""

import json
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from gateway.config import ZenohConfig
from gateway.contract.access.signatures import sign
from gateway.contract.access.writers import (
    EARLIEST,
    KEPT,
    LATEST,
    MOST_KEPT,
    Writers,
)
from gateway.contract.past.buckets import Bucket, Now
from gateway.contract.past.history_query import HistoryQuery
from gateway.errors import ConfigError, NotAllowed, Repeated
from gateway.northbound.northbound import Files
from gateway.northbound.requests.acceptance import AcceptedUntil
from gateway.tags import Sample, Tag
from gateway.tags.recorded import Recorded, RecordedQuery
from gateway.tags.timestamps import rfc3339
from tests.northbound.access import PAGE, secret
from tests.northbound.plant import mixer, northbound_of, running, until
from tests.zenoh_peer import ZenohPeer, free_endpoint

RECIPE = "plant/mixer/recipe/@set"
SECRET = "Zm9vYmFyYmF6cXV4Zm9vYmFyYmF6cXV4"  # noqa: S105  (of a test)
ALICE = f"alice:{SECRET}\n"


class RecordedWrites:
    """A history that only records the outcomes of writes."""

    def __init__(self) -> None:
        self.recorded: list[Any] = []

    def samples(self, tag: Tag, time_range: str, limit: int | None, now: int) -> Iterator[Sample]:
        raise NotImplementedError

    def buckets(
        self, tag: Tag, question: HistoryQuery, now: Now, pause: Callable[[], None]
    ) -> Iterator[Bucket]:
        raise NotImplementedError

    def newest(
        self, tag: Tag, question: HistoryQuery, now: int, pause: Callable[[], None]
    ) -> Iterator[Sample]:
        raise NotImplementedError

    def as_recorded(self, query: RecordedQuery, pause: Callable[[], None]) -> Recorded:
        raise NotImplementedError

    def writes(self, time_range: str, limit: int | None, now: int) -> Iterator[str]:
        raise NotImplementedError

    def alarms(self, time_range: str, limit: int | None, now: int) -> Iterator[str]:
        raise NotImplementedError

    def record_alarm(self, time: int, change: str) -> None:
        raise NotImplementedError

    def record_write(self, time: int, outcome: str, *, refused: bool) -> None:
        self.recorded.append(json.loads(outcome))


def signed(data: bytes, by: str = "alice", key: str = RECIPE, secret: str = SECRET) -> bytes:
    return sign(by, secret, rfc3339(time.time_ns()), key, data)


def past_start() -> Callable[[], bool]:
    """A condition: signatures made now are from after the start of the gateway."""
    began = time.time()
    return lambda: time.time() > began + EARLIEST


async def test_only_a_signed_request_writes_and_its_writer_is_named(tmp_path: Path) -> None:
    file = secret(tmp_path / "writers.txt", "# plant\n\n" + ALICE)
    plant, endpoint, history = mixer(), free_endpoint(), RecordedWrites()
    settings = ZenohConfig(listen=(endpoint,))
    northbound = northbound_of(plant, settings, files=Files(file), history=history)
    begun = past_start()
    async with running(northbound), ZenohPeer("client", connect=[endpoint]) as client:
        audit = await client.subscribe("plant/@gateway/demo/writes")
        await until(begun)
        wrong = (None, b"", SECRET.encode(), b"\xff" * 40, b"x" * 5000, signed(b"7", "bob"))
        for attachment in wrong:
            [reply] = await client.get(RECIPE, b"7", attachment=attachment)
            assert reply.json["error"] == "not-allowed"
            assert SECRET[:-1] not in reply.payload.decode()
            await client.put(RECIPE, b"7", attachment=attachment)
        stolen = signed(b"8")
        [reply] = await client.get(RECIPE, b"8", attachment=stolen)
        assert reply.ok
        [reply] = await client.get(RECIPE, b"8", attachment=stolen)
        assert reply.json["error"] == "unclear"  # for the writer: the first one was done
        await client.put(RECIPE, b"9", attachment=signed(b"9"))
        await audit.until(lambda of: len(of.samples) == 15)
        lines = [sample.json for sample in audit.samples]
        outcomes = [line["outcome"] for line in lines]
        assert outcomes == 12 * ["not-allowed"] + ["written", "not-allowed", "written"]
        assert [(line["value"], line["by"]) for line in lines if line["outcome"] == "written"] == [
            (8, "alice"),
            (9, "alice"),
        ]
        assert plant.written == [("mixer/recipe", 8), ("mixer/recipe", 9)]
        assert history.recorded == lines


class Clock:
    """The wall clock of a `Writers`, in seconds, and the one that is never set."""

    def __init__(self) -> None:
        self.now = 1_790_000_000.0
        self.passed = 0.0

    def wall(self) -> int:
        return int(self.now * 1e9)

    def monotonic(self) -> float:
        return self.passed

    def wait(self, seconds: float) -> None:
        self.now += seconds
        self.passed += seconds


def began(tmp_path: Path, clock: Clock, floor: float = 0.0) -> Writers:
    file = secret(tmp_path / "writers.txt", ALICE)
    return Writers(file, floor, clock.wall, clock.monotonic)


def known(tmp_path: Path) -> tuple[Writers, Clock]:
    """The writers of a gateway that began a minute ago."""
    clock = Clock()
    writers = began(tmp_path, clock)
    clock.wait(60)
    return writers, clock


def made(at: float, key: str = RECIPE, data: bytes = b"7") -> bytes:
    return sign("alice", SECRET, rfc3339(int(at * 1e9)), key, data)


def test_a_signature_covers_key_value_time_nonce_and_name(tmp_path: Path) -> None:
    writers, clock = known(tmp_path)
    attachment = made(clock.now)
    fields = json.loads(attachment)
    other = {
        "by": "bob",
        "time": rfc3339(int((clock.now - 1) * 1e9)),
        "nonce": "0" * 32,
        "signature": "0" * 64,
    }
    for name, text in other.items():
        with pytest.raises(NotAllowed, match="signature is wrong"):
            writers.writer(RECIPE, b"7", json.dumps({**fields, name: text}).encode())
    for key, data in ((RECIPE.replace("recipe", "speed"), b"7"), (RECIPE, b"8"), (RECIPE, b"")):
        with pytest.raises(NotAllowed, match="signature is wrong"):
            writers.writer(key, data, attachment)
    assert writers.writer(RECIPE, b"7", attachment) == "alice"
    with pytest.raises(Repeated):
        writers.writer(RECIPE, b"7", attachment)


@pytest.mark.parametrize("off", [-LATEST - 0.1, EARLIEST + 0.1, -3600.0, 3600.0])
def test_a_signature_counts_for_seconds(tmp_path: Path, off: float) -> None:
    writers, clock = known(tmp_path)
    with pytest.raises(NotAllowed, match=r"s ago|s ahead"):
        writers.writer(RECIPE, b"7", made(clock.now + off))
    for near in (-LATEST + 0.1, EARLIEST - 0.1, 0.0):
        assert writers.writer(RECIPE, b"7", made(clock.now + near)) == "alice"


def test_no_signature_counts_twice_whatever_the_clock_does(tmp_path: Path) -> None:
    writers, clock = known(tmp_path)
    attachment = made(clock.now + 0.9)
    writers.writer(RECIPE, b"7", attachment)
    for step in (1.0, 4.0, 1.0, -3.0, -600.0, 603.0, 10.0, -10.0):
        clock.now += step
        with pytest.raises((Repeated, NotAllowed)):
            writers.writer(RECIPE, b"7", attachment)


def test_a_signature_from_before_the_start_or_the_takeover_does_not_count(tmp_path: Path) -> None:
    clock = Clock()
    writers = began(tmp_path, clock)
    for at in (clock.now - 1, clock.now, clock.now + 0.9 * EARLIEST):
        with pytest.raises(NotAllowed, match="before the gateway began"):
            writers.writer(RECIPE, b"7", made(at))
    clock.wait(60)
    taken_by_the_other = made(clock.now - 2)
    writers.begin()
    with pytest.raises(NotAllowed):
        writers.writer(RECIPE, b"7", taken_by_the_other)
    assert writers.writer(RECIPE, b"7", made(clock.now + 0.1)) == "alice"


@pytest.mark.parametrize("waited", [0.0, 10.0, KEPT + 1])
def test_a_clock_that_is_set_back_makes_no_signature_count_again(
    tmp_path: Path, waited: float
) -> None:
    writers, clock = known(tmp_path)
    attachment = made(clock.now)
    writers.writer(RECIPE, b"7", attachment)
    clock.wait(waited)
    writers.writer(RECIPE, b"7", made(clock.now))
    clock.now -= waited
    with pytest.raises((Repeated, NotAllowed)):
        writers.writer(RECIPE, b"7", attachment)


def test_a_clock_that_was_a_day_ahead_locks_no_writer_out(tmp_path: Path) -> None:
    writers, clock = known(tmp_path)
    writers.writer(RECIPE, b"7", made(clock.now))
    clock.now += 86400
    ahead = made(clock.now)
    writers.writer(RECIPE, b"7", ahead)
    clock.wait(3)
    with pytest.raises(NotAllowed):
        writers.writer(RECIPE, b"7", made(clock.now - 86400))
    clock.now -= 86400
    assert writers.writer(RECIPE, b"7", made(clock.now)) == "alice"
    clock.wait(KEPT / 2)
    assert writers.writer(RECIPE, b"7", made(clock.now)) == "alice"
    clock.now += 86400 - KEPT / 2 - 3
    with pytest.raises(Repeated):
        writers.writer(RECIPE, b"7", ahead)


def test_nonces_take_no_memory_without_an_end(tmp_path: Path) -> None:
    writers, clock = known(tmp_path)
    first = made(clock.now)
    writers.writer(RECIPE, b"7", first)
    clock.wait(0.001)
    for _ in range(MOST_KEPT):
        writers.writer(RECIPE, b"7", made(clock.now))
    with pytest.raises(NotAllowed, match="has taken signatures until"):
        writers.writer(RECIPE, b"7", first)


async def test_a_restart_with_a_clock_that_was_set_back_accepts_nothing_again(
    tmp_path: Path,
) -> None:
    writers, clock = known(tmp_path)
    attachment = made(clock.now)
    writers.writer(RECIPE, b"7", attachment)
    await AcceptedUntil(tmp_path / "writers.json").keep(writers.newest)
    floor = AcceptedUntil(tmp_path / "writers.json").floor
    later = began(tmp_path, clock, floor)
    clock.passed += 60  # the gateway runs, the wall clock was set back
    with pytest.raises(NotAllowed, match="is a clock wrong"):
        later.writer(RECIPE, b"7", attachment)
    clock.now = floor + 1
    assert later.writer(RECIPE, b"7", made(clock.now)) == "alice"


async def test_a_full_disk_keeps_no_operator_from_writing(tmp_path: Path) -> None:
    accepted = AcceptedUntil(tmp_path / "missing" / "writers.json")
    await accepted.keep(1_790_000_000.0)
    assert accepted.floor == 0.0


def test_a_withdrawn_secret_or_a_file_readable_by_all_permits_no_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monotonic = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: monotonic[0])
    monkeypatch.setattr("gateway.contract.access.named_secrets._WAIT", 300.0)
    writers, clock = known(tmp_path)
    file = tmp_path / "writers.txt"

    def may(by: str) -> bool:
        try:
            attachment = sign(by, SECRET, rfc3339(clock.wall()), RECIPE, b"7")
            return writers.writer(RECIPE, b"7", attachment) == by
        except NotAllowed:
            return False

    assert may("alice")
    file.write_text(f"bob:{SECRET}\n")
    assert may("alice")  # the file is checked once a second
    monotonic[0] += 2
    assert (may("alice"), may("bob")) == (False, True)
    file.chmod(0o644)
    monotonic[0] += 2
    assert not may("bob")
    file.chmod(0o600)
    monotonic[0] += 2
    assert may("bob")
    file.unlink()
    monotonic[0] += 2
    assert not may("bob")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("alice", "line 1: write it as name:secret"),
        ("alice:" + SECRET[:19], "line 1: write it as name:secret, with 20 to 200"),
        (f"alice:0123456789abcdef:{'0' * 64}", "line 1: tokens are no longer sent"),
        (ALICE * 2, "line 2: alice is there twice"),
        ("".join(f"w{n}:{SECRET}\n" for n in range(101)), "more than 100"),
    ],
)
def test_a_bad_writers_file_is_a_configuration_error(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says) as raised:
        Writers(secret(tmp_path / "writers.txt", text))
    assert SECRET[:19] not in str(raised.value)


def test_the_command_of_the_page_makes_a_line_of_the_file(tmp_path: Path) -> None:
    (program,) = re.findall(r'^\$ python3 -c "(.*)"$', PAGE.read_text(), re.MULTILINE)
    out = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    clock = Clock()
    file = secret(tmp_path / "writers.txt", out.stdout)
    writers = Writers(file, 0.0, clock.wall, clock.monotonic)
    clock.wait(60)
    name, _, made_secret = out.stdout.strip().partition(":")
    attachment = sign(name, made_secret, rfc3339(clock.wall()), RECIPE, b"7")
    assert writers.writer(RECIPE, b"7", attachment) == "alice"
