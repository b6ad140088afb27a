"""examples/bridges/ros2.py with ROS 2: topics with a quality, and a service that writes."""

import json
import os
import platform
import re
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.bridges.played import PlayedGateway
from tests.conftest import forbidden, lacking
from tests.e2e.processes import ROOT, Program
from tests.zenoh_peer import free_endpoint

PYTHON = ROOT / "build" / "ros2" / "bin" / "python"
OK, ERROR, STALE = 0, 2, 3
TAGS: dict[str, dict[str, Any]] = {
    "mixer/speed": {"type": "float64", "unit": "rpm"},
    "mixer/recipe": {"write": {"min": 1, "max": 40, "verify": False}},
    "mixer/a.b": {},
    "mixer/a_b": {},
}
# Shared memory only: nothing of it leaves this machine, and another test hears nothing of it.
ALONE = ("env", "FASTDDS_BUILTIN_TRANSPORTS=SHM", f"ROS_DOMAIN_ID={os.getpid() % 200}")


def ros2(program: str, *options: object) -> Program:
    if not PYTHON.exists():
        if sys.version_info >= (3, 14) or platform.machine() != "x86_64":
            forbidden("PyPI has no ROS 2 for this Python on this machine")
        lacking("there is no ROS 2 in build/ros2 (.ci/install-peers)")
    return Program(*ALONE, f"PYTHONPATH={ROOT}", PYTHON, ROOT / program, *options)


@contextmanager
def memory_removed(*programs: Program) -> Iterator[None]:
    """Removes the shared memory of programs that are about to be killed: ROS 2 would leave it."""
    maps = "".join(Path(f"/proc/{program.pid}/maps").read_text() for program in programs)
    try:
        yield
    finally:
        for name in set(re.findall(r"/dev/shm/\S*fastdds_\w+", maps)):
            for end in ("", "_el", "_sl"):
                Path(name + end).unlink(missing_ok=True)
            mutex = Path(name).with_name(f"sem.{Path(name).name}_mutex")
            mutex.unlink(missing_ok=True)


def test_ros_2_shows_no_value_as_ok_that_is_not_good_and_writes_with_an_outcome() -> None:
    endpoint = free_endpoint()
    with (
        PlayedGateway(endpoint, TAGS) as gateway,
        ros2("examples/bridges/ros2.py", "--connect", endpoint, "--writes") as bridge,
        ros2("tests/bridges/ros2_robot.py", "/plant/mixer/speed", "/plant/set") as robot,
    ):

        def says(level: int, message: str, *others: str) -> list[object]:
            start = json.dumps([level, "mixer/speed", "mixer", message])[:-1]
            found: list[object] = json.loads(robot.says(start, *others))
            return found

        assert says(STALE, "starting")[4] == {"quality": "bad", "unit": "rpm"}
        gateway.put("mixer/speed", 12.5)
        about = says(OK, "good", "12.5")[4]
        assert about == {"quality": "good", "unit": "rpm", "value": "12.5"}
        bridge.says("mixer/a_b is not published: /plant/mixer/a_b is the topic of mixer/a.b")

        assert robot.tell("mixer/recipe 7") == "True written:"
        assert gateway.written == [("mixer/recipe", 7)]
        gateway.answer = "unclear"
        assert robot.tell("mixer/recipe 8").startswith("False unclear")
        assert robot.tell("mixer/other 8").startswith("False no-gateway")
        assert len(gateway.written) == 2

        gateway.put("mixer/speed", None, "refused")
        assert "value" not in str(says(ERROR, "refused")[4])
        gateway.put("mixer/speed", 13.5)
        says(OK, "good", "13.5")
        gateway.close()
        says(STALE, "no-gateway")
        with memory_removed(bridge, robot):
            bridge.end(signal.SIGKILL)
            robot.says("lost")
            robot.end(signal.SIGKILL)
