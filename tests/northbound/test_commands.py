"""Commands over Zenoh: executed or refused, answered, and audited."""

import asyncio
import json
import time
from typing import Any

import pytest
from structlog.testing import capture_logs

from gateway.config.commands import NotControlled
from gateway.contract.keys import Family, Keys, parse_key
from gateway.contract.problems import Failure, Problem
from gateway.engine.jobs.requests import CommandResult
from gateway.errors import LineDown
from gateway.northbound.requests.acceptance import Acceptance, Sender
from gateway.northbound.requests.audit import Audit
from gateway.northbound.requests.commands import Commands
from tests.northbound.plant import PlainPlant, mixer

KEYS = Keys("plant", "demo")
Documents = list[Any]  # the log line and the outcome on the `writes` key


@pytest.mark.parametrize(
    ("key", "family"),
    [
        (KEYS.command("oven", "run"), Family.COMMAND),
        (KEYS.command("oven", "stop"), Family.COMMAND),
        (KEYS.command("oven", "loopback"), Family.COMMAND),
        (KEYS.command("oven", "model"), Family.COMMAND),
        (KEYS.to_all("hall"), Family.COMMAND),
        ("plant/@gateway/demo/lines/hall", Family.STATUS),
        ("plant/@gateway/demo/lines/global", Family.STATUS),
        ("plant/@gateway/demo/**", Family.STATUS),
        ("plant/@gateway", Family.STATUS),
        ("plant/oven/run", Family.VALUE),
    ],
)
def test_keys_of_commands(key: str, family: Family) -> None:
    assert parse_key(key).family is family


def execute(
    plant: PlainPlant, key: str, data: bytes | None = None
) -> tuple[CommandResult | Failure, Documents]:
    published: list[bytes] = []
    recorded: list[str] = []
    with capture_logs() as logs:
        audit = Audit(published.append, lambda _, text, *, refused: recorded.append(text))
        commands = Commands(KEYS, plant, audit, Acceptance(plant.duty, None))
        sender = Sender("client", None, time.monotonic())
        result = asyncio.run(commands.execute(key, data, sender))
    assert [text.encode() for text in recorded] == published
    return result, [*logs, *(json.loads(line) for line in published)]


def test_a_command_is_executed_and_audited_like_a_write() -> None:
    plant = mixer()
    result, [line, outcome] = execute(plant, "plant/oven/@stop")
    assert result == plant.command_result
    assert (outcome["key"], outcome["value"], outcome["by"]) == ("plant/oven/@stop", None, "client")
    assert (outcome["outcome"], outcome["answer"]) == ("obeyed", "acknowledged")
    assert {"time", "took"} <= outcome.keys()
    assert plant.commanded == [("oven", "stop", "")]
    assert line["event"] == "command executed"
    assert (line["key"], line["by"], line["log_level"]) == ("plant/oven/@stop", "client", "info")
    _, [_, outcome] = execute(plant, "plant/@gateway/demo/lines/hall/global", b"on")
    assert outcome["value"] == "on"
    assert plant.commanded[-1] == ("oven", "global", "on")


@pytest.mark.parametrize(
    ("key", "data", "problem"),
    [
        ("plant/*/@stop", None, Problem.BAD_VALUE),
        ("plant/@gateway/demo/lines/*/global", b"on", Problem.BAD_VALUE),
        ("plant/@gateway/demo/lines/attic/global", b"on", Problem.BAD_VALUE),
        ("plant/oven/@loopback", b"\xff", Problem.BAD_VALUE),
        ("plant/oven/@loopback", b"A" * 2000, Problem.BAD_VALUE),
    ],
)
def test_a_bad_command_is_refused_and_audited(
    key: str, data: bytes | None, problem: Problem
) -> None:
    plant = mixer()
    result, [line, outcome] = execute(plant, key, data)
    assert isinstance(result, Failure)
    assert result.problem is problem
    assert plant.commanded == []
    assert (line["event"], line["log_level"]) == ("command failed", "warning")
    assert (outcome["key"], outcome["outcome"]) == (key, problem.value)


@pytest.mark.parametrize(
    ("error", "problem"),
    [
        (NotControlled("no"), Problem.NOT_WRITABLE),
        (LineDown("unplugged"), Problem.LINE_DOWN),
        (TimeoutError(), Problem.UNCLEAR),
    ],
)
def test_every_failed_command_has_its_error_word(error: Exception, problem: Problem) -> None:
    plant = mixer()
    plant.command_result = error
    result, [line, outcome] = execute(plant, "plant/oven/@stop")
    assert isinstance(result, Failure)
    assert result.problem is problem
    assert line["error"] == outcome["outcome"] == problem.value
    assert (line["event"] == "command unclear") == (problem is Problem.UNCLEAR)
