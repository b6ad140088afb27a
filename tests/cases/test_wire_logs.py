"""Wire logs of plants, one folder for each case: docs/contributors/wire-log-to-test.md."""

from pathlib import Path

import pytest

from gateway.errors import Refused
from gateway.protocols.driver import Span
from gateway.protocols.vigor import Vigor
from tests.cases.replay import pieces, transactions
from tests.doubles import Script, octets
from tests.vectors import vectors

LATE = Path(__file__).parent / "late_reply_and_bad_address" / "wire.log"


async def test_a_late_reply_to_another_request_is_not_accepted() -> None:
    driver = Vigor(station=0)
    words, bits, bad_address = transactions(LATE, "hall-1")
    read = await driver.read(Script(driver, *words), Span("D", 1, 2))
    assert list(read) == [0x1234, 0xABCD]
    # The reply to the first request arrives once more, before the reply to the second.
    read = await driver.read(Script(driver, *bits), Span("M", 8, 16))
    assert list(read) == [int(bit) for bit in f"{0x93A7:016b}"[::-1]]
    with pytest.raises(Refused) as refused:
        await driver.read(Script(driver, *bad_address), Span("D9", 9000, 1))
    assert refused.value.code == "28"


def test_the_frames_of_the_example_are_checked_frames_of_the_manual() -> None:
    known = {vector.frame for vector in vectors("vigor")}
    for request, *received in transactions(LATE, "hall-1"):
        assert octets(request[1:]) in known
        heard = b"".join(octets(piece[1:]) for piece in received)
        assert all(b"\x06" + frame in known for frame in heard.split(b"\x06")[1:])


def test_every_form_of_a_wire_log_is_read(tmp_path: Path) -> None:
    log = tmp_path / "wire.log"
    log.write_text(
        "hall-1 < 7f\n"
        "hall-1 > 02 30\n"
        "12.345678 < 06 30\n"
        "Nov 20 12:00:00 plant plc-gateway[123]: hall-1 > 02 31\n"
        "hall-2 > 05 05\n"
        "a sentence with > 02 30 in the middle\n"
    )
    assert transactions(log, "hall-1") == [["> 02 30", "< 06 30"], ["> 02 31"]]
    assert len(list(pieces(log))) == 5
