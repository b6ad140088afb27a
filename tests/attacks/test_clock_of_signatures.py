"""The clock of the gateway is wrong: no signed write counts twice, and no writer is locked out."""

import asyncio
import os
import signal
import sys
import time
from pathlib import Path

from tests.attacks.security_pages import client, plant_file
from tests.attacks.test_security_writers import RECIPE, Writer
from tests.e2e.processes import Program, free_port
from tests.northbound.access import secret
from tests.zenoh_peer import ZenohPeer

# The command itself, with a wall clock that is off by seconds in a file; SIGUSR1 reads it again.
RUN = """
import signal, sys, time
real, file, off = time.time_ns, sys.argv.pop(1), [0]
def read(*_): off[0] = int(open(file).read())
read()
time.time_ns = lambda: real() + off[0] * 10**9
signal.signal(signal.SIGUSR1, read)
from gateway.cli.main import main
main()
"""
DAY = 86400
ALICE = "alice:" + "a" * 40


def plant(folder: Path, port: int) -> Path:
    secret(folder / "writers.txt", ALICE + "\n")
    text = "zenoh: {listen: [tcp/127.0.0.1:7447]}\nwriters: {file: writers.txt}\n"
    return plant_file(folder, text, port)


def run(path: Path, off: int) -> Program:
    (path.parent / "off").write_text(str(off))
    program = Program(sys.executable, "-c", RUN, path.parent / "off", "run", path)
    program.says("Zenoh session ready")
    return program


def set_clock(folder: Path, program: Program, off: int) -> None:
    (folder / "off").write_text(str(off))
    os.kill(program.pid, signal.SIGUSR1)


async def refusal(peer: ZenohPeer, attachment: bytes) -> str:
    [reply] = await peer.get(RECIPE, b"7", attachment=attachment)
    assert not reply.ok
    return str(reply.json["reason"])


async def test_a_signed_write_counts_once_after_a_power_cut_and_a_clock_that_is_set_back(
    tmp_path: Path,
) -> None:
    endpoint = f"tcp/127.0.0.1:{(port := free_port())}"
    path = plant(tmp_path, port)
    with await asyncio.to_thread(run, path, 0) as program:
        async with client(endpoint) as peer:
            alice = Writer(peer, ALICE)
            await alice.until("ok")
            stolen, signed = alice.signed(b"7"), time.monotonic()
            [reply] = await peer.get(RECIPE, b"7", attachment=stolen)
            assert reply.ok
        program.end(signal.SIGKILL)
    with await asyncio.to_thread(run, path, -3600) as program:
        async with client(endpoint) as peer:
            assert "ahead of the gateway's clock" in await refusal(peer, stolen)
            # Its time comes again in seven seconds, however long the start has taken.
            set_clock(tmp_path, program, -round(time.monotonic() - signed) - 7)
            reasons = [await refusal(peer, stolen)]
            while "s ago" not in reasons[-1] or len(reasons) < 20:
                await asyncio.sleep(0.1)
                reasons.append(await refusal(peer, stolen))
            assert any("is a clock wrong?" in reason for reason in reasons)
            await Writer(peer, ALICE).until("not-allowed")
        assert not program.has_said("tag written")


async def test_a_clock_of_the_gateway_that_was_a_day_ahead_locks_no_writer_out(
    tmp_path: Path,
) -> None:
    endpoint = f"tcp/127.0.0.1:{(port := free_port())}"
    path = plant(tmp_path, port)
    with await asyncio.to_thread(run, path, 0) as program:
        async with client(endpoint) as peer:
            alice = Writer(peer, ALICE)
            await alice.until("ok")
            set_clock(tmp_path, program, DAY)
            assert await alice.says(b"7", alice.signed(b"7")) == "not-allowed"
            assert await alice.says(b"7", alice.signed(b"7", off=DAY)) == "ok"
            set_clock(tmp_path, program, 0)
            assert await alice.says(b"7", alice.signed(b"7")) == "ok"
