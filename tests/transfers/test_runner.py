"""The rows of a gateway on the virtual clock: ages, waits, reloads, and the rules of a write."""

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import orjson
import pytest

from gateway.contract.keys import Keys
from gateway.errors import Busy, Unclear
from gateway.line.send_permit import SendPermit
from gateway.northbound.requests.audit import Audit
from gateway.northbound.requests.writes import OwnWrites
from gateway.parts.transfers import Transfers
from gateway.plant.on_demand import OnDemand
from gateway.tags import Tag, WriteResult, good
from gateway.tags.mirror import Mirror
from gateway.tags.scan import Decoder
from gateway.values import Value
from tests.northbound.plant import mixer
from tests.reload.plant import Data, Plant, file, running, vigor
from tests.sim.plant import make_tag
from tests.sim.virtual import now, on_virtual_time
from tests.writing import write

SOURCE = {"n": {"address": "D10", "write": True}}
TARGET = {"n": {"address": "D20", "write": True}, "m": {"address": "D21", "write": True}}


class Rig:
    """A plant of simulated lines with its transfers, and every write of them."""

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self.written: list[tuple[float, str, Value, str]] = []
        gateway = plant.gateway
        self.transfers = Transfers(gateway, self._write, gateway.config.transfers)
        gateway.subscribe(self.transfers)
        gateway.doors.documents.append(self.transfers.documents)

    async def _write(self, tag: Tag, value: Value, by: str, within: float) -> WriteResult:
        assert within > 0
        self.written.append((now(), tag.key, value, by))
        return await write(self.plant.gateway, tag, value, min(within, 5.0))

    async def put(self, value: Value) -> None:
        tag = self.plant.gateway.tag("a/n")
        assert tag is not None
        await write(self.plant.gateway, tag, value)
        await asyncio.sleep(3)

    async def reload(self, change: Callable[[Data], object]) -> None:
        difference = await self.plant.reload(change)
        self.transfers.renew(difference.config.transfers, difference.renewed)
        await asyncio.sleep(3)

    @property
    def values(self) -> list[Value]:
        return [value for _, _, value, _ in self.written]

    def row(self, number: int) -> dict[str, Any]:
        return dict(self.plant.gateway.status()[f"transfers/{number}"])


@asynccontextmanager
async def rig(*rows: dict[str, Any]) -> AsyncIterator[Rig]:
    data = file(hall={"a": vigor(1, **SOURCE)}, yard={"b": vigor(2, **TARGET)})
    async with running(data | {"transfers": [*rows]}) as plant:
        made = Rig(plant)
        made.transfers.start()
        await plant.until_good("a/n", "b/n")
        await asyncio.sleep(3)
        try:
            yield made
        finally:
            await made.transfers.stop()


def row(**settings: Any) -> dict[str, Any]:
    return {"from": "a/n", "to": "b/n", **settings}


@on_virtual_time
async def test_each_change_is_carried_once_by_its_row() -> None:
    async with rig(row()) as made:
        await made.put(7)
        await made.put(8)
        assert made.values[-2:] == [7, 8]
        assert len(made.values) == 3  # the first good value too
        assert {by for *_, by in made.written} == {"transfer 1"}
        assert made.plant.sample("b/n").value == 8
        assert (made.row(1)["state"], made.row(1)["carried"]) == ("carried", 3)


@on_virtual_time
async def test_an_unchanged_row_goes_on_and_a_changed_one_begins_again() -> None:
    async with rig(row()) as made:
        await made.put(7)
        first = len(made.written)

        def describe(data: Data) -> None:
            data["lines"]["yard"]["devices"]["b"]["tags"]["n"]["description"] = "a copy"
            data["transfers"].insert(0, row(to="b/m"))

        await made.reload(describe)
        assert [(key, by) for _, key, _, by in made.written[first:]] == [("b/m", "transfer 1")]
        assert (made.row(2)["carried"], made.row(2)["to"]) == (first, "b/n")
        await made.put(8)
        assert {by for *_, by in made.written[-2:]} == {"transfer 1", "transfer 2"}

        await made.reload(lambda data: data["transfers"][1].update(offset=100))
        assert made.values[-1] == 108
        await made.reload(lambda data: data["transfers"].clear())
        count = len(made.written)
        await made.put(9)
        assert len(made.written) == count
        assert not any(path.startswith("transfers/") for path in made.plant.gateway.status())


@on_virtual_time
async def test_a_target_that_is_another_one_gets_the_value_again() -> None:
    async with rig(row()) as made:
        await made.put(7)
        count = len(made.written)

        def move(data: Data) -> None:
            data["lines"]["yard"]["devices"]["b"]["tags"]["n"]["address"] = "D40"

        await made.reload(move)
        assert made.values[count:] == [7]

        def other(data: Data) -> None:
            data["lines"]["yard"]["devices"]["b"]["station"] = 9

        await made.reload(other)
        assert made.values[count:] == [7, 7]


@on_virtual_time
async def test_the_age_of_a_value_counts_from_its_last_read() -> None:
    async with rig(row(every="1s", stale="3s")) as made:
        await asyncio.sleep(20)  # it never changes, and is read each second
        assert made.row(1)["state"] == "carried"
        assert made.row(1)["age"] < 1.2
        gateway = made.plant.gateway
        tag = gateway.tag("a/n")
        assert tag is not None
        line = gateway.lines[0]
        await made.plant.lines.end(line)  # its samples stay as they are
        await asyncio.sleep(2)
        poll = line.engine.schedule.reader(line.engine.devices[0], tag)
        assert poll is not None
        poll.reads.at = now() - 2.5
        count = len(made.written)
        await asyncio.sleep(5)
        assert len(made.written) <= count + 1
        assert made.row(1)["state"] == "stale"
        assert made.row(1)["why"] == "the last read of a/n is older than 3 s"


@on_virtual_time
async def test_a_range_is_carried_as_a_whole_and_goes_on_over_a_reload() -> None:
    range_row = {"from": "a:D10..D12", "to": "b:D30..D32"}
    async with rig(range_row, {"from": "a:M0..M2", "to": "b:M5..M7", "every": "1s"}) as made:
        await made.put(7)
        gateway = made.plant.gateway
        words = [value for _, key, value, _ in made.written if "D30" in key]
        assert words[-1][:1] == (7,)  # type: ignore[index]  # it is a tuple
        assert len(words[-1]) == 3  # type: ignore[arg-type]
        peeked = await gateway.peek("b", "D30..D32")
        assert tuple(peeked.units) == words[-1]
        assert made.row(2)["carried"] > 4
        assert "b/ranges/to/D30..D32" not in {s.tag.key for s in made.plant.published}
        count, before = made.row(1)["carried"], gateway.target("b/ranges/to/D30..D32")

        def describe(data: Data) -> None:
            data["lines"]["yard"]["devices"]["b"]["tags"]["n"]["description"] = "a copy"
            data["transfers"].append(row())

        await made.reload(describe)
        assert gateway.target("b/ranges/to/D30..D32") is before
        assert made.row(1)["carried"] > count
        assert made.row(3)["carried"] == 1
        await made.put(8)

        def move(data: Data) -> None:
            data["transfers"][0]["to"] = "b:D40..D42"

        await made.reload(move)
        assert before is not None
        with pytest.raises(Busy, match="the file was reloaded"):
            await write(gateway, before, (1, 2, 3))
        assert made.row(1)["carried"] < count
        assert tuple((await gateway.peek("b", "D40..D42")).units)[:1] == (8,)


@on_virtual_time
async def test_the_age_of_a_value_that_no_poll_reads_counts_from_its_arrival() -> None:
    tags = [make_tag(f"D{number}") for number in (1, 2)]
    on_demand = OnDemand(lambda device: None, Mirror(tags, 0).__getitem__)
    assert on_demand.age(tags[0]) == float("inf")
    await asyncio.sleep(1)
    decoder = Decoder(tags, range(2))
    scan = decoder.first([7, 8], 1)  # as the line that only listens makes it
    on_demand.note(scan)
    await asyncio.sleep(2)
    assert on_demand.age(tags[0]) == pytest.approx(2)
    on_demand.note([good(tags[0], 9, 2)])  # as a frame or a master makes it
    await asyncio.sleep(3)
    assert on_demand.age(tags[0]) == pytest.approx(3)
    assert on_demand.age(tags[1]) == float("inf")  # nothing asked for it before


def own(plant: Any) -> tuple[OwnWrites, list[dict[str, Any]]]:
    outcomes: list[dict[str, Any]] = []
    audit = Audit(lambda data: outcomes.append(orjson.loads(data)))
    return OwnWrites(Keys("plant", "demo"), plant, audit), outcomes


async def test_a_write_of_a_transfer_is_audited_by_its_name() -> None:
    plant = mixer()
    tag = plant.tag("mixer/recipe")
    assert tag is not None
    writes, outcomes = own(plant)
    plant.endings[13] = Unclear("no reply")
    assert (await writes.write(tag, 12, "transfer 4", 5.0)).value == 12
    with pytest.raises(Unclear):
        await writes.write(tag, 13, "transfer 4", 5.0)
    with pytest.raises(ValueError, match="above the greatest value"):
        await writes.write(tag, 9000, "transfer 4", 5.0)
    assert [(one["by"], one["outcome"]) for one in outcomes] == [
        ("transfer 4", "written"),
        ("transfer 4", "unclear"),
        ("transfer 4", "bad-value"),
    ]
    assert plant.written == [("mixer/recipe", 12)]


async def test_a_gateway_that_may_not_be_the_active_one_carries_nothing() -> None:
    plant = mixer()
    plant.duty = SendPermit(shared=True)
    tag = plant.tag("mixer/recipe")
    assert tag is not None
    writes, outcomes = own(plant)
    with pytest.raises(Busy, match="another gateway of the standby group may be active"):
        await writes.write(tag, 12, "transfer 1", 5.0)
    assert [one["outcome"] for one in outcomes] == ["busy"]
    plant.duty.prove(asyncio.get_running_loop().time())
    await writes.write(tag, 12, "transfer 1", 5.0)
    assert plant.written == [("mixer/recipe", 12)]


async def test_a_write_is_not_sent_after_its_value_is_too_old() -> None:
    plant, seen = mixer(), list[float]()

    async def write(tag: Tag, value: Value, within: float) -> WriteResult:
        seen.append(within)
        return WriteResult(value, time.time_ns(), 0.1)

    plant.write = write  # type: ignore[method-assign]  # it notes
    tag = plant.tag("mixer/recipe")
    assert tag is not None
    for within in (0.25, 60.0):
        await own(plant)[0].write(tag, 12, "transfer 1", within)
    assert seen == [0.25, 5.0]
