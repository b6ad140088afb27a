"""A write or command is accepted, or refused before its key and value are looked at."""

import json
import time
from datetime import UTC, datetime, timedelta

import pytest

from gateway.engine.jobs.requests import WRITE_EXPIRY
from gateway.errors import Busy
from gateway.line.send_permit import SendPermit
from gateway.northbound.requests.acceptance import Acceptance, Sender

NOW = 1_790_000_000  # seconds since 1970


async def within(acceptance: Acceptance, waited: float, attachment: bytes | None = None) -> float:
    sender = Sender("session", attachment, time.monotonic() - waited)
    accepted = acceptance.accept("plant/mixer/recipe/@set", b"7", sender)
    assert accepted.by == "session"
    return accepted.within


def open_to_all(duty: SendPermit | None = None) -> Acceptance:
    return Acceptance(duty or SendPermit(), None, lambda: NOW * 10**9)


def made(seconds_ago: float) -> bytes:
    time = datetime.fromtimestamp(NOW, UTC) - timedelta(seconds=seconds_ago)
    return json.dumps({"time": time.isoformat()}).encode()


async def test_a_write_ages_from_its_arrival_or_from_its_own_time() -> None:
    assert await within(open_to_all(), 0.0) == pytest.approx(WRITE_EXPIRY, abs=0.5)
    assert await within(open_to_all(), 2.0) == pytest.approx(WRITE_EXPIRY - 2, abs=0.5)
    assert await within(open_to_all(), 0.0, made(3.0)) == pytest.approx(WRITE_EXPIRY - 3, abs=0.5)
    assert await within(open_to_all(), 3.0, made(1.0)) == pytest.approx(WRITE_EXPIRY - 3, abs=0.5)
    for waited, attachment in ((6.0, None), (0.0, made(6.0)), (6.0, made(0.0))):
        with pytest.raises(Busy, match="s old; not sent"):
            await within(open_to_all(), waited, attachment)


@pytest.mark.parametrize(
    "attachment",
    [b"", b"no JSON", b"[]", b'{"time": 5}', b'{"time": "x"}', b'{"time": "0001-01-01T00:00:00"}'],
)
async def test_an_attachment_without_a_time_says_nothing(attachment: bytes) -> None:
    assert await within(open_to_all(), 0.0, attachment) == pytest.approx(WRITE_EXPIRY, abs=0.5)


async def test_what_waited_while_the_process_was_held_is_refused() -> None:
    released = time.monotonic()
    acceptance = open_to_all(SendPermit(lambda: released))
    with pytest.raises(Busy, match="stood still"):
        await within(acceptance, 3.0)
