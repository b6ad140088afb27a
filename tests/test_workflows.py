"""Hosted CI: it runs what developers run, on every machine and Python; releases are attested."""

import re
import tomllib
from typing import Any

import pytest
import yaml

from tests.e2e.processes import ROOT

WORKFLOWS = sorted((ROOT / ".github/workflows").glob("*.yml"))
CLASSIFIERS = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["classifiers"]
PYTHONS = re.findall(r"Python :: (3\.\d+)", "\n".join(CLASSIFIERS))
TARGETS = set(re.findall(r"^([a-z]+|\.venv/ready):", (ROOT / "Makefile").read_text(), re.MULTILINE))


def workflow(name: str) -> dict[str, Any]:
    loaded: dict[str, Any] = yaml.safe_load((ROOT / f".github/workflows/{name}.yml").read_text())
    return loaded


def commands(job: dict[str, Any]) -> list[str]:
    return [step["run"] for step in job["steps"] if "run" in step]


@pytest.mark.parametrize("name", [file.stem for file in WORKFLOWS])
def test_a_workflow_has_few_rights_a_time_limit_and_commands_that_exist(name: str) -> None:
    loaded = workflow(name)
    assert loaded["permissions"] == {"contents": "read"}
    for job in loaded["jobs"].values():
        assert job["timeout-minutes"] <= 300
        [checkout] = (step for step in job["steps"] if "checkout" in step.get("uses", ""))
        assert checkout["with"]["persist-credentials"] is False
        text = "\n".join(commands(job))
        # A value of the event that stands in a command could be a command.
        assert "${{" not in text
        assert set(re.findall(r"\bmake ([a-z]+|\.venv/ready)", text)) <= TARGETS
        for script in re.findall(r"\.ci/[\w-]+", text):
            assert (ROOT / script).is_file()


def test_every_action_is_pinned_by_one_commit_and_names_its_version() -> None:
    found: dict[str, set[str]] = {}
    for file in WORKFLOWS:
        for line in re.findall(r"uses: (.*)$", file.read_text(), re.MULTILINE):
            action, pin = line.split("@")
            assert re.fullmatch(r"[0-9a-f]{40} # v\d+\.\d+\.\d+", pin), line
            found.setdefault(action, set()).add(pin)
    assert found
    assert {action: pins for action, pins in found.items() if len(pins) > 1} == {}


@pytest.mark.parametrize("job", ["test", "archive"])
def test_ci_runs_on_every_supported_python_and_machine(job: str) -> None:
    found = workflow("ci")["jobs"][job]
    assert found["strategy"]["matrix"] == {
        "machine": ["ubuntu-24.04", "ubuntu-24.04-arm"],
        "python": PYTHONS,
    }
    assert found["runs-on"] == "${{ matrix.machine }}"
    assert found["container"]["image"] == "python:${{ matrix.python }}-bookworm"


def test_ci_runs_the_same_as_a_developer() -> None:
    jobs = workflow("ci")["jobs"]
    assert commands(jobs["test"])[-1] == "bash .ci/run"
    assert jobs["test"]["steps"][-1]["env"] == {"PYTHON": "python${{ matrix.python }}"}
    assert commands(jobs["archive"])[-1] == ".ci/smoke dist/*-offline.tar"
    assert commands(jobs["coverage"])[-1] == "make coverage"
    assert commands(jobs["docs"])[-1] == "make docs"


def test_hosted_ci_asks_whether_a_pinned_version_has_a_known_weakness() -> None:
    assert commands(workflow("ci")["jobs"]["audit"]) == ["bash .ci/audit"]
    text = (ROOT / ".ci/audit").read_text()
    files = {file.name for file in ROOT.glob("constraints*.txt")} - {"constraints.txt"}
    assert {name for name in files if name not in text} == set()


def test_each_night_tries_other_seeds_mutants_and_inputs() -> None:
    jobs = workflow("nightly")["jobs"]
    assert {
        name: commands(job)[-1].split()[:2] for name, job in jobs.items() if name != "fuzz"
    } == {
        "seeds": ["make", "sim"],
        "mutants": ["make", "mutants"],
    }
    assert 'SEEDS="${RUN}000-${RUN}999"' in commands(jobs["seeds"])[-1]
    kept = [step for step in jobs["fuzz"]["steps"] if "cache" in step.get("uses", "")]
    assert [step["with"]["path"].split() for step in kept] == [["tests/fuzz/corpus", ".hypothesis"]]
    assert any("make fuzz" in command for command in commands(jobs["fuzz"]))
    assert any("make parsers" in command for command in commands(jobs["fuzz"]))


def test_the_release_is_built_twice_and_attested() -> None:
    """`make release` builds twice; tests/test_release.py has its comparison."""
    job = workflow("release")["jobs"]["build"]
    steps = [step.get("run") or step["uses"].partition("@")[0] for step in job["steps"]]
    order = [".ci/audit", "make release", ".ci/smoke", "actions/attest", "gh release create"]
    places = [next(n for n, step in enumerate(steps) if word in step) for word in order]
    assert places == sorted(places)
    attest = job["steps"][places[3]]
    assert attest["with"] == {"subject-checksums": "dist/SHA256SUMS"}
    assert job["permissions"] == {
        "contents": "write",
        "id-token": "write",
        "attestations": "write",
    }


def test_the_systems_that_the_package_names_are_those_of_ci() -> None:
    systems = [line for line in CLASSIFIERS if line.startswith("Operating System")]
    assert systems == ["Operating System :: POSIX :: Linux"]
    assert "| Windows | none: `run` needs" in (ROOT / "docs/deployment.md").read_text("utf-8")
