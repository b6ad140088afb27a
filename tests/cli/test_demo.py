"""The demo: a page with good values without a file, and nothing left behind."""

import json
import re
import signal
import socket
import sys
import urllib.request
from pathlib import Path

from gateway.cli.config.demo import free_port
from tests.e2e.processes import Program, until
from tests.zenoh_peer import free_port as unused_port


def test_one_command_shows_a_page_with_values_and_leaves_nothing(tmp_path: Path) -> None:
    run = (sys.executable, "-m", "gateway", "demo", "--no-browser")
    with Program("env", f"TMPDIR={tmp_path}", *run) as demo:
        demo.says("Ctrl-C ends it")
        [page] = re.findall(r"^Page: (\S+)$", "\n".join(demo.lines), re.MULTILINE)
        [folder] = tmp_path.iterdir()
        assert f"watch {folder}/plant.yaml" in "\n".join(demo.lines)

        def are_good() -> bool:
            with urllib.request.urlopen(f"{page}api/tags") as reply:  # noqa: S310  (http)
                return {one["quality"] for one in json.load(reply)["tags"]} == {"good"}

        until(are_good, "all values are good")
        demo.end(signal.SIGINT)
    assert list(tmp_path.iterdir()) == []


def test_a_port_that_is_taken_is_replaced_by_a_free_one() -> None:
    taken = unused_port()
    with socket.socket() as other:
        other.bind(("127.0.0.1", taken))
        assert free_port(taken) not in (taken, 0)
    assert free_port(taken) == taken
