"""docs/security.md, writers and records: each rule, with its attacker."""

import asyncio
import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from gateway.contract.access.signatures import sign
from gateway.contract.access.writers import EARLIEST, LATEST
from gateway.tags.timestamps import rfc3339
from tests.attacks.security_pages import block, client, plant_file, quoted, serving, table
from tests.e2e.processes import free_port, plc_gateway
from tests.northbound.access import secret
from tests.zenoh_peer import TIMEOUT, ZenohPeer

RECIPE, LOOPBACK = "plant/mixer/recipe/@set", "plant/oven/@loopback"
BOB = "b" * 40


def line_of_the_page() -> str:
    """Returns Alice's line, as the command of the page makes it."""
    console = block("Name the writer", "console")
    (program,) = re.findall(r'^\$ python3 -c "(.*)"$', console, re.MULTILINE)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True)
    return done.stdout.decode().strip()


class Writer:
    """A client that signs. `off`: seconds between the time of the signature and now."""

    def __init__(self, peer: ZenohPeer, line: str) -> None:
        self.peer = peer
        self.name, _, self._secret = line.partition(":")

    def signed(self, value: bytes, key: str = RECIPE, off: float = 0.0) -> bytes:
        at = rfc3339(time.time_ns() + int(off * 1e9))
        return sign(self.name, self._secret, at, key, value)

    async def says(self, value: bytes, attachment: bytes | None, key: str = RECIPE) -> str:
        """Writes. Returns the error, or `ok`."""
        [reply] = await self.peer.get(key, value, attachment=attachment)
        return "ok" if reply.ok else str(reply.json["error"])

    async def until(self, answer: str) -> None:
        """Signs writes until this is the answer."""
        async with asyncio.timeout(300):
            while await self.says(b"7", self.signed(b"7")) != answer:
                await asyncio.sleep(0.05)


async def test_only_writers_write_and_a_signature_counts_once_and_for_seconds(
    tmp_path: Path,
) -> None:
    unsigned, again, late, by = table("Name the writer")
    assert (unsigned[1], late[1]) == 2 * ("refused as `not-allowed`",)
    assert again[1].startswith("refused: `unclear`")
    assert by[1] == "the name of the writer"
    assert late[0] == f"a signature older than {LATEST:g} s, or {EARLIEST:g} s ahead"
    line = line_of_the_page()
    file = secret(tmp_path / "writers.txt", f"{line}\nbob:{BOB}\n")
    endpoint = f"tcp/127.0.0.1:{(port := free_port())}"
    text = "zenoh: {listen: [tcp/127.0.0.1:7447]}\n" + block("Name the writer", "yaml")
    path = plant_file(tmp_path, text, port, control=True, history={"path": "h.db"})
    with await asyncio.to_thread(serving, path) as program:
        async with client(endpoint) as peer:
            alice, bob = Writer(peer, line), Writer(peer, f"bob:{BOB}")
            mallory = Writer(peer, f"alice:{BOB}")
            outcomes = await peer.subscribe("plant/@gateway/demo/writes")
            await alice.until("ok")
            for attachment in (
                None,
                line.encode(),
                mallory.signed(b"8"),
                alice.signed(b"9"),
                alice.signed(b"8", LOOPBACK),
                alice.signed(b"8", off=-LATEST - 1),
                alice.signed(b"8", off=EARLIEST + 1),
            ):
                assert await alice.says(b"8", attachment) == "not-allowed", attachment
                await peer.put(RECIPE, b"8", attachment)
            assert await alice.says(b"AB", None, LOOPBACK) == "not-allowed"
            stolen = alice.signed(b"8")
            assert await alice.says(b"8", stolen) == "ok"
            assert await alice.says(b"8", stolen) == "unclear"
            command = ("control", path, "oven", "loopback", "AB")
            own = {"PLC_GATEWAY_WRITER": line}
            done = await asyncio.to_thread(plc_gateway, *command, env=own)
            assert (done.code, done.err) == (0, ""), done
            await is_recorded_everywhere(peer, outcomes.samples, program.lines)
            # The file is read again. Bob's line is deleted, then the file cannot be read.
            quoted("To withdraw a secret, delete its line.")
            assert await bob.says(b"7", bob.signed(b"7")) == "ok"
            file.write_text(line)
            await bob.until("not-allowed")
            assert await alice.says(b"7", alice.signed(b"7")) == "ok"
            quoted(
                "If the file becomes unreadable, or its disk does not answer for ten seconds, "
                "every write is refused."
            )
            file.unlink()
            await alice.until("not-allowed")
            secret(file, line)
            await alice.until("ok")
            last = alice.signed(b"9")
            assert await alice.says(b"9", last) == "ok"
        program.end(signal.SIGKILL)
    quoted("A gateway that starts or becomes active accepts no signature from before.")
    with await asyncio.to_thread(serving, path):
        async with client(endpoint) as peer:
            assert await Writer(peer, line).says(b"9", last) == "not-allowed"


async def is_recorded_everywhere(peer: ZenohPeer, published: list[Any], log: list[str]) -> None:
    """Each outcome: time, key, value, outcome, duration, and by whom."""
    quoted("time, key, value, outcome, duration, and by whom")
    lines, past = list[Any](), [None]
    async with asyncio.timeout(TIMEOUT):  # subscriber and history may each be late
        while past != lines or json.dumps(lines).count("not-allowed") < 15:
            asked = "plant/@gateway/demo/writes?_time=[now(-1h)..]"
            past = [reply.json for reply in await peer.get(asked, consolidation="NONE")]
            lines = [sample.json for sample in published]
    done = [line for line in lines if line["outcome"] in ("written", "obeyed")]
    assert [(line["key"], line["value"]) for line in done] == [
        ("plant/mixer/recipe", 7),
        ("plant/mixer/recipe", 8),
        (LOOPBACK, "AB"),
    ]
    for line in done:
        assert line["by"] == "alice"
        assert {"time", "took"} <= line.keys()
    for event, number in (("tag written", 2), ("command executed", 1)):
        logged = [entry for entry in log if event in entry and "by=alice" in entry]
        assert len(logged) == number
        assert all("key=" in entry and "took=" in entry for entry in logged)
