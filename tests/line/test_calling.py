"""Telephone calls: when a line dials, when it hangs up, and what becomes of values and writes."""

import asyncio
from typing import Any

import pytest

from gateway.contract.status import line_document
from gateway.engine.forecast import forecast
from gateway.errors import LineDown, Unclear
from gateway.tags import Quality, Reason
from tests.line.telephone import Telephone, now, running
from tests.sim.virtual import on_virtual_time
from tests.transport.modem import ModemModel

QUARTER = 15 * 60


@on_virtual_time
async def test_every_15_min_dials_once_for_all_that_is_due() -> None:
    tags = {f"level{n}": {"address": f"D{n}", "every": "15min"} for n in (100, 900, 2000)}
    async with running(Telephone(ModemModel(after=12.0), tags)) as far:
        await asyncio.sleep(60)
        assert (far.model.calls, far.model.online) == (1, False)
        assert far.now["level100"].value == 17
        await asyncio.sleep(4 * QUARTER)
        assert far.model.calls == 5
        assert far.now["level2000"].quality is Quality.GOOD
        assert far.line.engine.record.last_trouble == ""


def shown(far: Telephone) -> dict[str, Any]:
    """The calls in the status document of the line."""
    engine = far.line.engine
    polls = forecast(engine.name, engine.devices, engine.wire)
    document: Any = line_document(engine, polls, far.line.calls, now())
    found: dict[str, Any] = document["calls"]
    return found


@on_virtual_time
async def test_the_status_shows_each_state_of_the_calls() -> None:
    words = ("BUSY", "CONNECT 9600")
    far = Telephone(ModemModel(words, after=5.0), retry_pause="30s", idle="4s")
    async with running(far):
        await asyncio.sleep(4)
        dials = shown(far)
        assert (dials["state"], dials["next"], dials["last_result"]) == ("dialling", None, "")
        await asyncio.sleep(6)
        busy = shown(far)
        assert (busy["state"], busy["in_a_row"], busy["last_result"]) == ("idle", 1, "BUSY")
        assert 0 < busy["since"] < 6
        assert busy["next"] == pytest.approx(30 - busy["since"], abs=0.2)
        await asyncio.sleep(busy["next"] + 6)
        lasts = shown(far)
        assert (lasts["state"], lasts["connected"], lasts["made"]) == ("connected", True, 1)
        await asyncio.sleep(20)
        done = shown(far)
        assert (done["state"], done["in_a_row"], done["last_result"]) == ("idle", 0, "complete")
        assert done["results"] == {"BUSY": 1, "complete": 1}
        assert QUARTER - 60 < done["next"] < QUARTER


@on_virtual_time
async def test_the_counts_of_calls_outlive_the_modem() -> None:
    far = Telephone(ModemModel())
    async with running(far):
        await asyncio.sleep(3)
        assert shown(far)["state"] == "connected"
        far.model.deaf = True
        far.line.lost(LineDown("unplugged"))
        await asyncio.sleep(0.1)
        lost = shown(far)
        assert (lost["state"], lost["next"], lost["last_result"]) == ("idle", None, "modem lost")
        assert (lost["made"], lost["failed"], lost["last_failure"]) == (1, 1, "unplugged")
        far.model.deaf = False
        await asyncio.sleep(QUARTER)
        assert shown(far)["made"] >= 2


@on_virtual_time
async def test_a_call_reads_what_is_due_within_half_its_interval() -> None:
    tags = {
        "often": {"address": "D100", "every": "10min"},
        "seldom": {"address": "D900", "every": "15min"},
    }
    async with running(Telephone(ModemModel(), tags)) as far:
        await asyncio.sleep(3600 - 30)
        assert far.model.calls == 6  # at 0, 10, 20, 30, 40, 50 minutes
        polls = far.line.engine.schedule.polls(far.device)
        assert sum(poll.reads.count for poll in polls) == 6 + 6


@on_virtual_time
async def test_values_stay_good_between_two_calls() -> None:
    async with running(Telephone(ModemModel())) as far:
        await asyncio.sleep(10)
        first = far.now["level"]
        assert first.quality is Quality.GOOD
        await asyncio.sleep(QUARTER - 20)
        assert far.now["level"] is first
        assert not far.model.online


@on_virtual_time
async def test_a_write_dials_at_once() -> None:
    async with running(Telephone(ModemModel(after=30.0))) as far:
        await asyncio.sleep(60)
        assert not far.model.online
        result = await far.write(7)
        assert 30 < result.took < 35  # longer than a write waits for another line
        assert far.plc.memory.read("D", 200) == [7]
        await asyncio.sleep(20)
        assert far.now["limit"].value == 7
        assert not far.model.online


@on_virtual_time
async def test_a_write_that_waits_for_longer_than_a_dial_is_not_sent() -> None:
    tries = ("CONNECT 9600", "NO ANSWER", "CONNECT 9600")
    far = Telephone(ModemModel(tries, after=40.0), retry_pause="30s")
    async with running(far):
        await asyncio.sleep(100)
        writing = far.write(7)
        with pytest.raises(Exception, match=r"waited 65\.. s for the line; not sent"):
            await writing
        await asyncio.sleep(200)
        assert far.plc.memory.read("D", 200) == [0]


@on_virtual_time
@pytest.mark.parametrize("word", ["BUSY", "NO CARRIER", "NO DIALTONE", "NO ANSWER"])
async def test_b3_8_three_calls_that_fail_make_the_values_bad(word: str) -> None:
    far = Telephone(ModemModel(("CONNECT 9600", word), after=5.0))
    async with running(far):
        await asyncio.sleep(60)
        assert far.now["level"].quality is Quality.GOOD
        await asyncio.sleep(QUARTER - 60)
        writing = far.write(7)
        await asyncio.sleep(5 + 10 + 5)
        assert far.now["level"].quality is Quality.GOOD  # two of three calls
        with pytest.raises(LineDown, match=rf"{word}.*; not sent"):
            await writing
        bad = far.now["level"]
        assert (bad.quality, bad.reason) == (Quality.BAD, Reason.LINE_DOWN)
        assert bad.detail == f"/dev/ttyS0: {word} (3 calls in a row failed)"
        assert far.dials == 4
        await asyncio.sleep(QUARTER - 60)
        assert far.dials == 4  # it gave up until the next interval
        far.model.dials = ("CONNECT 9600",)
        await asyncio.sleep(120)
        assert far.now["level"].quality is Quality.GOOD


@on_virtual_time
async def test_b3_8_a_minute_without_a_carrier_is_a_failed_call() -> None:
    async with running(Telephone(ModemModel(("",)))) as far:
        await asyncio.sleep(3 * 60 + 2 * 10 + 20)
        assert far.dials == 3
        assert "no carrier within 60 s" in far.now["level"].detail


@on_virtual_time
async def test_a_failed_call_is_tried_again_for_a_write() -> None:
    far = Telephone(ModemModel(("BUSY", "BUSY", "BUSY", "CONNECT 9600")), retry_pause="1s")
    async with running(far):
        await asyncio.sleep(10)
        assert (far.now["level"].quality, far.dials) == (Quality.BAD, 3)
        await far.write(7)
        assert far.plc.memory.read("D", 200) == [7]
        await asyncio.sleep(10)
        assert far.now["level"].value == 17


@on_virtual_time
async def test_a_write_is_unclear_when_the_carrier_is_lost_in_its_reply() -> None:
    async with running(Telephone(ModemModel())) as far:
        await asyncio.sleep(60)
        far.cuts = [False, True]  # of the resync and of the write
        with pytest.raises(Unclear, match="NO CARRIER; it is unknown if the write was done"):
            await far.write(7)
        assert far.plc.memory.read("D", 200) == [7]
        await asyncio.sleep(30)
        assert far.now["limit"].value == 7


@on_virtual_time
async def test_a_write_is_not_sent_when_the_carrier_is_lost_before_it() -> None:
    async with running(Telephone(ModemModel())) as far:
        await asyncio.sleep(60)
        far.cuts = [True]
        with pytest.raises(LineDown, match="NO CARRIER; not sent"):
            await far.write(7)
        await asyncio.sleep(60)
        assert far.plc.memory.read("D", 200) == [0]


@on_virtual_time
async def test_a_carrier_lost_in_a_frame_makes_the_values_bad_and_dials_again() -> None:
    far = Telephone(ModemModel())
    far.cuts = [True]
    async with running(far):
        await asyncio.sleep(3)
        assert far.now["level"].reason is Reason.LINE_DOWN
        assert "NO CARRIER" in far.now["level"].detail
        await asyncio.sleep(20)
        assert (far.now["level"].value, far.model.calls) == (17, 2)
        await asyncio.sleep(QUARTER / 2)
        assert far.model.calls == 2


@on_virtual_time
async def test_a_line_that_always_breaks_is_not_dialled_without_end() -> None:
    far = Telephone(ModemModel())
    far.cuts = [True] * 1000
    async with running(far):
        await asyncio.sleep(QUARTER - 30)
        assert far.model.calls == 3
        await asyncio.sleep(QUARTER)
        assert far.model.calls == 6


@on_virtual_time
async def test_the_other_side_may_hang_up_when_all_is_done() -> None:
    async with running(Telephone(ModemModel(), idle="1min")) as far:
        await asyncio.sleep(20)
        assert far.model.online
        far.say(far.model.drop())
        await asyncio.sleep(QUARTER - 60)
        assert far.model.calls == 1
        assert far.now["level"].quality is Quality.GOOD


@on_virtual_time
async def test_a_silent_station_does_not_hold_the_line() -> None:
    far = Telephone(ModemModel())
    far.plc.mute = True
    async with running(far):
        await asyncio.sleep(60)
        assert (far.model.calls, far.model.online) == (1, False)
        assert far.now["level"].reason is Reason.NO_REPLY
        await asyncio.sleep(QUARTER - 90)
        assert far.model.calls == 1
        far.plc.mute = False
        await asyncio.sleep(120)
        assert far.now["level"].value == 17


@on_virtual_time
async def test_each_call_begins_with_a_resync() -> None:
    """Another station may have taken the call."""
    async with running(Telephone(ModemModel())) as far:
        await asyncio.sleep(60)
        first = far.model.data
        far.model.data = b""
        await asyncio.sleep(QUARTER)
        probe = far.model.data[: far.model.data.index(b"\x03") + 3]
        assert probe != first[: len(probe)]  # it has a token of its own
        assert far.model.data.count(b"\x03") == 3  # resync, D100 and D200


@on_virtual_time
async def test_a_modem_that_answers_nothing_is_a_line_that_is_down() -> None:
    async with running(Telephone(ModemModel(deaf=True))) as far:
        await asyncio.sleep(60)
        assert "does not answer AT commands" in far.line.engine.record.trouble
        with pytest.raises(LineDown, match="does not answer AT commands"):
            await far.write(7)
        far.model.deaf = False
        await asyncio.sleep(60)
        assert far.now["level"].value == 17


@on_virtual_time
async def test_a_read_on_demand_dials() -> None:
    async with running(Telephone(ModemModel())) as far:
        await asyncio.sleep(60)
        far.plc.memory.write("D", 100, [18])
        far.line.expedite(far.device, far.tag("level"))
        await asyncio.sleep(5)
        assert (far.now["level"].value, far.model.calls) == (18, 2)
