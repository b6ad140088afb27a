"""Telephones that the modem of a line dials because of an alarm: between calls, and bounded."""

import asyncio
import time

import pytest

from gateway.errors import Busy, LineDown
from gateway.line.calling import MOST_RINGS
from gateway.parts.notify.message import message
from gateway.parts.notify.settings import NotifySection
from gateway.parts.notify.watch import TEST
from gateway.parts.notify.ways import DIALLED_WITHIN, ways, why_not_sent
from gateway.tags import Quality
from tests.line.telephone import Telephone, now, running
from tests.sim.virtual import on_virtual_time
from tests.transport.modem import ModemModel

NUMBER = "0912345678,,,911"
RING = f"ATDT{NUMBER};"
CALL, DIALLED = "CONNECT 9600", "OK"


def dials(far: Telephone) -> list[str]:
    return [one for one in far.model.commands if one.startswith(("ATD", "ATH"))]


@on_virtual_time
async def test_a_telephone_is_dialled_behind_the_call_of_a_device_and_values_stay() -> None:
    async with running(Telephone(ModemModel((CALL, DIALLED), after=2.0), idle="20s")) as far:
        await asyncio.sleep(5)
        assert far.model.online
        ring = asyncio.create_task(far.line.ring(NUMBER))
        await asyncio.sleep(5)
        assert far.model.online  # the call goes on
        assert not ring.done()
        await ring
        assert dials(far) == ["ATDT26204393", "ATH", RING, "ATH"]
        assert b"0912" not in far.model.data
        assert far.now["level"].quality is Quality.GOOD
        again = asyncio.create_task(far.line.ring(NUMBER))  # at once: no call is there
        began = now()
        await again
        assert now() - began < 5
        assert far.line.calls is not None
        assert (far.line.calls.record.made, far.line.calls.record.failed) == (1, 0)


@on_virtual_time
async def test_the_words_of_the_modem_say_why_not_and_devices_are_called_on() -> None:
    words = (CALL, "BUSY", "NO DIALTONE", "NO CARRIER", "", CALL)
    async with running(Telephone(ModemModel(words), dial_timeout="40s")) as far:
        await asyncio.sleep(20)
        for said in ("BUSY", "NO DIALTONE", "NO CARRIER", "no OK within 40 s"):
            with pytest.raises(LineDown, match=f"^/dev/ttyS0: {said}"):
                await far.line.ring(NUMBER)
        await asyncio.sleep(15 * 60)
        assert far.model.calls == 2
        assert far.now["level"].quality is Quality.GOOD


@on_virtual_time
async def test_a_modem_that_answers_is_hung_up_and_a_ringing_one_does_not_dial() -> None:
    async with running(Telephone(ModemModel((CALL, CALL)))) as far:
        await asyncio.sleep(20)
        await far.line.ring(NUMBER)
        await asyncio.sleep(1)
        assert not far.model.online
        far.say(far.model.ring())
        await asyncio.sleep(0.1)
        with pytest.raises(LineDown, match="RING: an incoming call"):
            await far.line.ring(NUMBER)


@on_virtual_time
async def test_telephones_that_wait_are_bounded_and_a_client_that_left_is_not_rung() -> None:
    async with running(Telephone(ModemModel((CALL, DIALLED)), idle="20s")) as far:
        with pytest.raises(LineDown, match="its modem is not there"):
            await far.line.ring(NUMBER)
        await asyncio.sleep(5)
        waiting = [asyncio.create_task(far.line.ring(NUMBER)) for _ in range(MOST_RINGS)]
        await asyncio.sleep(0)
        with pytest.raises(Busy, match="8 telephones are waiting"):
            await far.line.ring(NUMBER)
        for task in waiting[1:]:
            task.cancel()
        await waiting[0]
        await asyncio.sleep(5)
        assert dials(far).count(RING) == 1


@on_virtual_time
async def test_a_modem_that_is_lost_ends_what_waits() -> None:
    async with running(Telephone(ModemModel((CALL, "")))) as far:
        await asyncio.sleep(20)
        waiting = [asyncio.create_task(far.line.ring(NUMBER)) for _ in range(2)]
        await asyncio.sleep(1)
        far.line.lost(LineDown("unplugged"))
        assert far._cable is not None
        far._cable.receiver.lost(LineDown("unplugged"))
        for task in waiting:
            with pytest.raises(LineDown):
                await task


SETTINGS = {"telephone": {"line": "far", "number": NUMBER}, "rules": [{"to": ["telephone"]}]}


@on_virtual_time
async def test_an_alarm_dials_a_telephone_and_says_why_it_did_not() -> None:
    settings = NotifySection.model_validate(SETTINGS)
    test = message("plant", "demo", [TEST], time.time_ns())
    async with running(Telephone(ModemModel((CALL, DIALLED, "BUSY", "")))) as far:
        send = ways(settings, lambda _line, number: far.line.ring(number))["telephone"]
        await asyncio.sleep(20)
        assert await why_not_sent(send, test) == ""
        assert await why_not_sent(send, test) == "/dev/ttyS0: BUSY"
        began = now()
        assert await why_not_sent(send, test) == "/dev/ttyS0: no OK within 60 s"
        assert now() - began < DIALLED_WITHIN
    nowhere = ways(settings)["telephone"]
    assert "only the gateway that runs dials" in await why_not_sent(nowhere, test)
