"""Speed of simulated time: one line of eight stations under full load.

python -m benchmarks.sim_speed
"""

import argparse
import asyncio
import time

import structlog

from tests.sim.plant import device, plant, running, words
from tests.sim.virtual import run_virtual


async def _line(seconds: float, every: float) -> int:
    devices = [device(words(100, 20, every=every), station=n) for n in range(1, 9)]
    hall = plant(devices)
    published = 0

    def count(_samples: object) -> None:
        nonlocal published
        published += 1

    hall.samples = count  # type: ignore[method-assign,assignment]  # keeping them all costs time
    async with running(hall):
        await asyncio.sleep(seconds)
    return published


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0, help="simulated")
    seconds = parser.parse_args().minutes * 60
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(50))
    for every in (0.5, 5.0, 30.0):
        began = time.perf_counter()
        exchanges = run_virtual(_line(seconds, every))
        took = time.perf_counter() - began
        print(
            f"every {every:4g} s: {seconds / 3600 / (took / 60):6.1f} simulated hours per minute, "
            f"{exchanges / seconds:5.2f} exchanges per simulated second, "
            f"{exchanges / took:6.0f} per real second"
        )


if __name__ == "__main__":
    main()
