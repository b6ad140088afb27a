"""The `write` command through the running gateway."""

from pathlib import Path

import pytest

from gateway.cli.client import connected
from gateway.cli.write import outcome
from gateway.config import load
from gateway.errors import GatewayError
from tests.cli.conftest import TAGS, documents
from tests.conftest import Command
from tests.e2e.processes import held, started, until, until_exit, vigor_line, write_config
from tests.zenoh_peer import free_endpoint


@pytest.mark.parametrize("direct", [[], ["--direct"]])
@pytest.mark.parametrize(
    ("tag", "value", "says"),
    [
        ("mixer/sped", "1", "there is no tag mixer/sped"),
        ("mixer/speed", "1", "mixer/speed cannot be written"),
        ("mixer/trim", "41", "mixer/trim: 41 is above the greatest value 40"),
        ("mixer/trim", "-6", "mixer/trim: -6 is below the least value -5"),
        ("mixer/trim", "1.5", "mixer/trim: 1.5"),
        ("mixer/trim", "[/b]", "mixer/trim: "),
        ("mixer/run", "maybe", "mixer/run: "),
    ],
)
def test_an_impossible_write_ends_with_2(
    command: Command, config: Path, direct: list[str], tag: str, value: str, says: str
) -> None:
    done = command("write", config, tag, value, *direct)
    assert (done.code, done.out) == (2, "")
    assert says in done.err
    assert len(done.err.splitlines()) == 1


@pytest.mark.parametrize(
    ("tag", "typed", "value", "how"),
    [
        ("mixer/trim", "-3", "-3", "acknowledged and read back"),
        ("mixer/offset", "-12.5", "-12.5", "acknowledged by the PLC"),
        ("mixer/run", "true", "true", "acknowledged by the PLC"),
        ("mixer/level", str(10**20), "1e+20", "acknowledged by the PLC"),
        ("mixer/name", "[bold]12[/bold]", "[bold]12[/bold]", "acknowledged by the PLC"),
        ("mixer/name", "12", "12", "acknowledged by the PLC"),
        ("mixer/name", '"a b"', "a b", "acknowledged by the PLC"),
    ],
)
def test_write_prints_the_reply_of_the_plc(
    command: Command, running: Path, tag: str, typed: str, value: str, how: str
) -> None:
    done = command("write", running, tag, typed)
    assert (done.code, done.err) == (0, "")
    assert done.out.startswith(f"{tag} = {value}: {how} (simulated), ")
    assert done.out.endswith(" ms\n")

    def is_read() -> bool:  # a slow machine may miss a reply
        row = command("read", running, tag, "--json", "--max-age", "0s").json
        return str(row["value"]) == value.replace("true", "True")

    until(is_read, f"{tag} is {value}")


def test_write_as_json(command: Command, running: Path) -> None:
    done = command("write", running, "mixer/trim", "-5", "--json")
    [answer] = documents(done.out)
    assert (done.code, answer["value"], answer["verified"]) == (0, -5, True)
    assert set(answer) == {"value", "time", "verified", "acknowledged", "took", "origin"}


def test_a_write_to_a_tag_unknown_to_the_gateway_ends_with_2(command: Command, newer: Path) -> None:
    done = command("write", newer, "mixer/new", "1")
    assert (done.code, done.out) == (2, "")
    assert done.err.startswith("mixer/new: unknown-tag: there is no tag at plant/mixer/new")
    done = command("read", newer, "mixer/new")
    assert done.code == 1
    assert "no reply: is the gateway of this file running?" in done.err


def test_a_gateway_that_hangs_does_not_get_the_write(command: Command, tmp_path: Path) -> None:
    lines = {"hall": vigor_line("simulator", TAGS)}
    path = write_config(tmp_path / "config.yaml", free_endpoint(), lines)
    with started(path) as program:
        program.says("device online")
        assert command("write", path, "mixer/trim", "1").code == 0
        with (
            connected(load(path), print) as client,
            held(program.pid),
            pytest.raises(GatewayError, match="nothing was sent"),
        ):
            client.requests.write("mixer/trim", 2)
        read = until_exit(0, command, "read", path, "mixer/trim", "--json", "--max-age", "0s")
        assert read.json["value"] == 1


@pytest.mark.parametrize(
    ("answer", "line"),
    [
        (
            {"value": 12, "took": 0.0311, "verified": True},
            "t = 12: acknowledged and read back, 31 ms",
        ),
        (
            {"value": True, "took": 0.031, "verified": False},
            "t = true: acknowledged by the PLC, 31 ms",
        ),
        (
            {"value": 1, "took": 0.1, "verified": False, "acknowledged": False},
            "t = 1: broadcast, without acknowledgement, 100 ms",
        ),
        (
            {"error": "refused", "code": "28", "reason": "data address out of range"},
            "t: refused 28: data address out of range",
        ),
        ({"error": "busy", "code": None, "reason": "later"}, "t: busy: later"),
    ],
)
def test_the_outcome_of_a_write_is_one_line(answer: dict[str, object], line: str) -> None:
    assert outcome("t", answer) == line
