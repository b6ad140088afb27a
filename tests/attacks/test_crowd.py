"""A crowd at the page of the real program closes it to nobody; `make crowd` makes 10,000."""

import asyncio
from pathlib import Path

from gateway.parts.web.connections import MOST_CONNECTIONS
from tests.attacks.crowd import ASKED, attack, plant
from tests.e2e.processes import free_port, started


async def test_curl_and_a_slow_client_are_answered_in_a_crowd(tmp_path: Path) -> None:
    port, count = free_port(), 3 * MOST_CONNECTIONS
    with await asyncio.to_thread(started, plant(tmp_path, port)) as gateway:
        await asyncio.to_thread(gateway.says, "web page ready")
        seen = await attack(gateway, port, count)
        assert seen.opened == count
        assert seen.statuses == dict.fromkeys(ASKED, "200")
        assert seen.whole
        assert seen.files < MOST_CONNECTIONS + 100
        assert not gateway.has_said("Traceback")
