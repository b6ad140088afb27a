"""The first five minutes: the example runs, and the commands that it proposes work."""

import json
import shlex
import signal
import subprocess
import urllib.request
from pathlib import Path

from tests.e2e.processes import PATIENCE, ROOT, Done, Program, started
from tests.zenoh_peer import free_endpoint, free_port


def test_the_example_runs_and_its_proposed_commands_work(tmp_path: Path) -> None:
    text = (ROOT / "config.example.yaml").read_text()
    assert text.count("listen: [tcp/127.0.0.1:7447]") == 1
    path = tmp_path / "config.yaml"  # as it is, but for the ports, which may be taken here
    page = f"127.0.0.1:{free_port()}"
    assert text.count("127.0.0.1:8080") == 1
    text = text.replace("tcp/127.0.0.1:7447", free_endpoint()).replace("127.0.0.1:8080", page)
    path.write_text(text)
    with started(path) as program:
        program.says("Ctrl-C ends it.")
        for _ in range(3):
            program.says("device online")
        first = next(i for i, line in enumerate(program.lines) if "In a second terminal:" in line)
        assert program.lines[first - 1] == f"Page: http://{page}/"
        with urllib.request.urlopen(f"http://{page}/api/tags?limit=1", timeout=PATIENCE) as reply:
            assert json.load(reply)["total"] == 27
        said = program.lines[first + 1 :]
        steps = [shlex.split(line) for line in said if line.startswith("  ") and str(path) in line]
        assert [_verb(step) for step in steps] == ["watch", "read", "write"]
        watch, read, write = steps

        with Program(*watch) as watching:
            shown = watching.says("mixer/speed", "good")
            after = watching.lines.index(shown) + 1
            # Soon after its start the gateway publishes all values again.
            while (later := watching.says("mixer/speed", "good", after=after)) == shown:
                after = watching.lines.index(later, after) + 1
            assert watching.end(signal.SIGINT) == 0
        done = _typed(read)
        assert done.code == 0
        assert "good" in done.out
        done = _typed(write)
        assert (done.code, done.err) == (0, "")
        assert "acknowledged" in done.out
        everything = _typed([*read[: read.index("read") + 1], str(path)])
        assert everything.code == 0
        assert everything.out.count(" good, simulated ") == 27
        assert program.end(signal.SIGINT) == 0


def _verb(step: list[str]) -> str:
    return next(word for word in step if word in ("watch", "read", "write"))


def _typed(words: list[str]) -> Done:
    done = subprocess.run(
        words, capture_output=True, text=True, timeout=PATIENCE, check=False, cwd=ROOT
    )
    return Done(done.returncode, done.stdout, done.stderr)
