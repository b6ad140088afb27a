"""Requests and line time of a cycle in several gateways: `python -m benchmarks.peers_requests`.

Gateways are usually compared with this set: 100 registers in a row, 50 at every second and 50 at
every tenth register, all with one interval. No wire is needed: one cost model, Modbus RTU with
10 ms turnaround, gives the time of every plan. `--write` writes peers_requests.md again.
"""

import argparse
from collections.abc import Iterable
from pathlib import Path

from gateway.planning.planner import plan
from gateway.planning.wire_timing import WireTiming
from gateway.protocols.driver import Address, Cost, Span, Unit
from gateway.protocols.modbus import ModbusRtu
from gateway.tags import Tag
from gateway.values import Layout, parse_type

TURNAROUND = 0.010
LIMIT = 125  # registers of one request
BAUDS = (9600, 19200, 38400, 115200)
DRIVER = ModbusRtu(station=1)


def addresses() -> list[int]:
    row = list(range(100))
    seconds = [1000 + 2 * n for n in range(50)]
    tenths = [2000 + 10 * n for n in range(50)]
    return row + seconds + tenths


def tags() -> list[Tag]:
    return [
        Tag(
            device="plc",
            name=f"t{n}",
            text=f"holding:{n}",
            address=Address("holding", n),
            span=Span("holding", n, 1),
            unit_kind=Unit.WORD,
            layout=Layout(parse_type("uint16")),
        )
        for n in addresses()
    ]


def seconds(wire: WireTiming, size: int) -> float:
    cost = DRIVER.cost(Span("holding", 0, size))
    assert cost is not None
    return wire.transaction(cost, DRIVER.timing, TURNAROUND)


def fixed_gap(gap: int) -> list[int]:
    """Returns the sizes of the requests that include at most `gap` unused registers in a row."""
    sizes: list[int] = []
    start = last = addresses()[0]
    for address in addresses()[1:]:
        if address - last - 1 > gap or address - start + 1 > LIMIT:
            sizes.append(last - start + 1)
            start = address
        last = address
    return [*sizes, last - start + 1]


def optimum(wire: WireTiming) -> float:
    """Returns the least time by dynamic programming, independent of the planner that it checks."""
    row = addresses()
    best = [0.0]
    for j in range(1, len(row) + 1):
        best.append(
            min(
                best[i] + seconds(wire, row[j - 1] - row[i] + 1)
                for i in range(j)
                if row[j - 1] - row[i] + 1 <= LIMIT
            )
        )
    return best[-1]


def ours(wire: WireTiming) -> list[int]:
    def price(cost: Cost) -> float:
        return wire.transaction(cost, DRIVER.timing, TURNAROUND)

    return [block.span.size for block in plan(tags(), DRIVER, price)]


def rows() -> Iterable[str]:
    yield "| way to merge | " + " | ".join(f"{baud} baud" for baud in BAUDS) + " |"
    yield "|---|" + "---|" * len(BAUDS)
    wires = [WireTiming(baud, 11) for baud in BAUDS]
    ways = [
        ("one request per tag", [[1] * len(addresses())] * len(BAUDS)),
        *((f"fixed gap {gap}", [fixed_gap(gap)] * len(BAUDS)) for gap in (0, 1, 10, 50)),
        ("**this planner**", [ours(wire) for wire in wires]),
    ]
    for name, plans in ways:
        cells = [
            f"{len(sizes)} requests, {sum(seconds(wire, size) for size in sizes):.2f} s"
            for wire, sizes in zip(wires, plans, strict=True)
        ]
        yield f"| {name} | " + " | ".join(cells) + " |"
    least = [f"{optimum(wire):.2f} s" for wire in wires]
    yield "| the least there is | " + " | ".join(least) + " |"


HEAD = """# Requests and line time of one cycle

200 registers: 100 in a row, 50 at every second and 50 at every tenth register, all wanted
equally often. Modbus RTU, 8E1, 10 ms turnaround, 3.5 characters of silence (1.75 ms above 19200
baud), at most 125 registers a request. Calculated by `python -m benchmarks.peers_requests
--write`; no wire is needed.

For this set a fixed gap of 10 happens to be the optimum at all four rates; it would not be with
a slower line, a quicker station or other distances. One request per tag and no gap at all are
dear everywhere.

"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="renew peers_requests.md")
    table = "\n".join(rows()) + "\n"
    if parser.parse_args().write:
        Path(__file__).with_suffix(".md").write_text(HEAD + table)
    print(table)


if __name__ == "__main__":
    main()
