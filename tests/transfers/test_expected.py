"""The forecasts of a running gateway: those that `check` prints for the same file."""

from typing import Any

import pytest

from gateway.parts.transfers.forecast import forecasts
from gateway.plant.plant import Plant
from tests.reload.plant import Data, file, running, vigor
from tests.sim.virtual import on_virtual_time

SOURCE: dict[str, Any] = {
    "n": {"address": "D10", "every": "500ms"},
    "twice": {"computed": "2 * n"},
}
TARGET = {"n": {"address": "D20", "write": {"verify": True}}}


def shown(gateway: Plant) -> dict[str, tuple[float, float]]:
    """Returns load and requests a second of each line in its status document."""
    documents: dict[str, Any] = {**gateway.status()}
    lines = {path: one for path, one in documents.items() if path.startswith("lines/")}
    return {
        path.removeprefix("lines/"): (
            one["expected"]["load"],
            one["expected"]["requests_per_second"],
        )
        for path, one in lines.items()
    }


def checked(gateway: Plant) -> dict[str, tuple[float, float]]:
    lines = forecasts(gateway.config)
    return {one.name: (round(one.load, 4), round(one.requests, 3)) for one in lines}


@on_virtual_time
async def test_the_load_counts_transfers_as_check_does_also_after_a_reload() -> None:
    data = file(hall={"a": vigor(1, **SOURCE)}, yard={"b": vigor(2, **TARGET)})
    async with running(data) as plant:
        gateway = plant.gateway
        polls = shown(gateway)
        rows = [{"from": "a/twice", "to": "b/n"}, {"from": "b/n", "to": "a:D30"}]

        await plant.reload(lambda data: data.update(transfers=rows[:1]))
        one = shown(gateway)
        assert one == checked(gateway)
        assert one["yard"][1] == polls["yard"][1] + 2  # a write for each read of the source
        assert one["yard"][0] > polls["yard"][0]
        assert one["hall"] == polls["hall"]

        def seldom(data: Data) -> None:
            data["lines"]["hall"]["devices"]["a"]["tags"]["n"]["every"] = "2s"

        await plant.reload(seldom)
        other = shown(gateway)
        assert other == checked(gateway)
        assert other["yard"][1] == polls["yard"][1] + 0.5

        def another_line(data: Data) -> None:
            data["lines"]["roof"] = file(roof={"c": vigor(3, **TARGET)})["lines"]["roof"]
            data["transfers"] = [{"from": "a/n", "to": "c/n", "every": "250ms"}]

        await plant.reload(another_line)
        last = shown(gateway)
        assert last == checked(gateway)
        assert last["yard"] == pytest.approx(polls["yard"])
        assert last["roof"][1] == polls["yard"][1] + 4
