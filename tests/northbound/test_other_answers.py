"""Another program that answers queries of own values: a storage of Zenoh has old ones."""

import asyncio
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import zenoh

from gateway.contract.faults import warnings
from gateway.contract.keys import Keys
from gateway.northbound.group.claiming import Claiming
from tests.sim.virtual import on_virtual_time
from tests.web.serving import PlainNorth

KEY = "plant/mixer/speed"


class Asked:
    """The part of a session that the question uses. `stored`: another program answers."""

    def __init__(self) -> None:
        self.stored = False
        self.asked: list[tuple[str, object]] = []

    def get(self, key: str, *, allowed_destination: object, **_how: object) -> Iterator[Any]:
        self.asked.append((key, allowed_destination))
        yield SimpleNamespace(ok=None)  # an error is no value
        if self.stored:
            yield SimpleNamespace(ok=object())


@on_virtual_time
async def test_a_program_that_answers_for_own_values_is_said_while_it_does() -> None:
    claiming = Claiming(Keys("plant", "demo"), None, None, [], asyncio.Event(), asyncio.Event())
    session: Any = Asked()
    keys = iter([None, KEY, KEY, KEY])
    noticing = asyncio.create_task(claiming.notice_answers(session, lambda: next(keys), 30.0))
    found = []
    await asyncio.sleep(15.0)  # each look is between two questions
    for stored in (True, False, True, False):
        session.stored = stored
        await asyncio.sleep(30.0)
        found.append(claiming.status()["answered_elsewhere"])
    noticing.cancel()
    assert found == [None, None, KEY, None]  # without tags nothing is asked
    assert session.asked == [(KEY, zenoh.Locality.REMOTE)] * 3


async def test_the_status_warns_of_it() -> None:
    documents = dict(await PlainNorth().documents(0.0))
    assert not any("another program" in one for one in warnings(documents))
    documents["status"] = {**documents["status"], "answered_elsewhere": KEY}
    assert any(f"queries of {KEY}, such as a storage" in one for one in warnings(documents))
