"""Speed and memory of each framing with 100 MB of noise.

.venv/bin/python benchmarks/frames_noise.py [megabytes]
"""

import random
import sys
import time
import tracemalloc

from gateway.protocols.frames import FrameReader, Framing

PIECE = 64 * 1024
FRAMINGS = {
    "header, terminator": Framing(header="<02>", terminator="<03>"),
    "header, terminator, sum": Framing(header="<02>", terminator="<03>", sum_check=True),
    "terminator": Framing(terminator="<03>"),
    "CR LF": Framing(ending="CR LF"),
    "converted": Framing(header="<02>", terminator="<03>", conversion=True),
    "header, 512 bytes": Framing(header="<02>", terminator="<03>", length=512),
    "gap": Framing(),
}


def noises() -> dict[str, list[bytes]]:
    seeded = random.Random(1)
    repeated = {"A": b"A", "STX": b"\x02", "ETX": b"\x03", "STX A": b"\x02A", "CR": b"\r"}
    pieces = {name: [(unit * PIECE)[:PIECE]] for name, unit in repeated.items()}
    return {"random": [seeded.randbytes(PIECE) for _ in range(16)], **pieces}


def run(framing: Framing, pieces: list[bytes], megabytes: float) -> tuple[float, int, int]:
    """Seconds, bytes kept at the end, and the most bytes in use at any time."""
    reader = FrameReader(framing)
    tracemalloc.start()
    before, _ = tracemalloc.get_traced_memory()
    started = time.perf_counter()
    for turn in range(int(megabytes * 1024 * 1024 / PIECE)):
        reader.feed(pieces[turn % len(pieces)])
    took = time.perf_counter() - started
    after, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return took, after - before, peak - before


def main() -> None:
    megabytes = float(sys.argv[1]) if len(sys.argv) > 1 else 100
    print(f"{'framing':26}{'noise':10}{'MB/s':>8}{'kept kB':>10}{'peak kB':>10}")
    for name, framing in FRAMINGS.items():
        for noise, pieces in noises().items():
            took, kept, peak = run(framing, pieces, megabytes)
            speed = megabytes / took
            print(f"{name:26}{noise:10}{speed:8.1f}{kept / 1000:10.1f}{peak / 1000:10.1f}")


if __name__ == "__main__":
    main()
