"""Goes through docs/first-plant.md: every command prints what the page shows."""

import re
import shlex
import signal
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.e2e.processes import gateway, plc_gateway, started, until
from tests.test_docs import EXAMPLE, _blocks, shape
from tests.zenoh_peer import free_endpoint, free_port

PAGE = "first-plant.md"
[FILE] = [block.text for block in _blocks(PAGE) if block.language == "yaml"]
FIRST_PORT = 4001  # and the two after it


class Step(NamedTuple):
    """A command of the page and the lines below it; the line `…` stands for further lines."""

    command: list[str]
    shown: list[str]


def steps(page: str = PAGE) -> Iterator[Step]:
    for block in _blocks(page):
        if block.language == "console":
            for entry in re.split(r"^\$ ", block.text, flags=re.MULTILINE)[1:]:
                command, *shown = entry.splitlines()
                if command.startswith("plc-gateway "):
                    yield Step(shlex.split(command)[1:], shown)


def normal(line: str) -> str:
    """The shape of a line, with its columns separated by one space."""
    return " ".join(shape(line).split())


@pytest.fixture(name="ports")
def _ports() -> dict[str, str]:
    """Replaces the ports of the page by free ones."""
    first = free_port(3)
    replaced = {f"127.0.0.1:{FIRST_PORT + i}": f"127.0.0.1:{first + i}" for i in range(3)}
    return replaced | {"tcp/127.0.0.1:7447": free_endpoint(), "config.example.yaml": str(EXAMPLE)}


def test_every_step_of_the_tutorial_prints_what_the_page_shows(
    ports: dict[str, str], tmp_path: Path
) -> None:
    def here(text: str) -> str:
        for old, new in ports.items():
            text = text.replace(old, new)
        return text

    (tmp_path / "plant.yaml").write_text(here(FILE))
    (tmp_path / "mistake.yaml").write_text(here(FILE).replace("every: 500ms", "every: 500"))
    simulate, *rest = steps()
    *before, last = rest
    assert (simulate.command[0], last.command[0]) == ("simulate", "read")

    def command(step: Step) -> list[str]:
        return [here(word) for word in step.command]

    def prints(step: Step) -> bool:
        done = plc_gateway(*command(step), cwd=tmp_path)
        printed = [normal(line) for line in (done.out + done.err).splitlines()]
        shown = [normal(here(line)) for line in step.shown]
        if "…" in shown:
            return set(shown) - {"…"} <= set(printed)
        return sorted(shown) == sorted(printed)

    with ExitStack() as stack:
        plc = stack.enter_context(gateway(*command(simulate)))
        for line in simulate.shown:
            plc.says(here(line))
        for step in before:
            if step.command[0] == "run":
                stack.enter_context(started(tmp_path / step.command[1])).says("device online")
            else:
                until(partial(prints, step), f"{step.command} prints what the page shows")
        plc.end(by=signal.SIGINT)
        until(partial(prints, last), "the value turns bad")
