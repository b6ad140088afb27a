"""Parts of the simulated world: foreign answers, frozen loops, manners, result files."""

import asyncio
from pathlib import Path
from typing import NoReturn

import pytest

from gateway.engine.engine import Engine
from gateway.errors import Busy, GatewayError, Unclear
from gateway.protocols.checksums import byte_sum
from gateway.protocols.vigor.codec import Request, encode
from gateway.stations.computer_link import ComputerLinkStation
from gateway.stations.modbus import ModbusStation
from gateway.stations.vigor import VigorStation
from gateway.tags import WriteResult
from gateway.tags.transfer import TransferRule
from tests.sim import campaign
from tests.sim.foreign import Foreign
from tests.sim.freezer import Ear, Freezer
from tests.sim.manners import Holes, is_unknown, refusal
from tests.sim.plant import make_tag
from tests.sim.requests import shape_of
from tests.sim.transfers import MAY_COME, Row
from tests.sim.virtual import now, on_virtual_time
from tests.sim.world import run

ASK, LIKE, OTHER = b"A1", b"A2", b"B1"  # the letter is the shape


def watched() -> Foreign:
    foreign = Foreign(lambda request: (request[:1],))
    foreign.sent(ASK, 1.0, resync=False, proves=False)
    return foreign


def test_an_answer_of_the_same_shape_to_another_master_cannot_be_told() -> None:
    foreign = watched()
    foreign.answered_other(LIKE, b"=2", 1.0, unknown=False)
    assert foreign.took(b"=2")


def test_an_answer_of_another_shape_can_be_told() -> None:
    foreign = watched()
    foreign.answered_other(OTHER, b"=2", 1.0, unknown=False)
    assert not foreign.took(b"=2")


def test_an_answer_after_an_older_own_one_can_be_told() -> None:
    """The older answer of the same shape had ended the question."""
    foreign = watched()
    foreign.answered(LIKE, b"=1")
    foreign.answered_other(LIKE, b"=2", 1.0, unknown=False)
    assert not foreign.took(b"=1=2")


def test_an_answer_before_the_question_can_be_told() -> None:
    foreign = watched()
    foreign.answered_other(LIKE, b"=2", 1.0, unknown=False)
    foreign.sent(ASK, 1.0, resync=False, proves=False)
    assert not foreign.took(b"=2")


def test_a_second_station_is_alone_until_a_reply_of_the_first_has_arrived() -> None:
    """Both may say the same; `hostile` seed 1800012."""
    foreign = watched()
    foreign.answered_other(ASK, b"=0", 1.0, unknown=True)
    assert foreign.is_alone([b"=0"], b"=0")
    assert not foreign.is_alone([b"=0"], b"=0=0")
    assert not foreign.is_alone([b"=1"], b"=0=1")


def test_a_second_station_answers_for_the_first_only_the_open_question() -> None:
    foreign = watched()
    foreign.answered_other(LIKE, b"=2", 1.0, unknown=True)
    assert not foreign.took(b"=2")
    foreign.answered_other(ASK, b"=2", 1.0, unknown=True)
    assert foreign.took(b"=2")


@pytest.mark.parametrize(
    ("protocol", "one", "like", "other"),
    [
        ("modbus-rtu", "0103000a0002", "010300140002", "0103000a0003"),
        ("modbus-rtu", "0101000a0009", "01010014000f", "0101000a0011"),
    ],
)
def test_the_shape_of_a_read_is_that_of_its_reply(
    protocol: str, one: str, like: str, other: str
) -> None:
    shapes = [shape_of(protocol, bytes.fromhex(text)) for text in (one, like, other)]
    assert shapes[0] == shapes[1] != shapes[2]


@pytest.mark.parametrize(
    ("station", "request_", "code"),
    [
        (VigorStation(1), encode(Request(1, "51", b"FFFF02")), "33"),
        (ComputerLinkStation(1), b"\x0501FFWR0D999901" + byte_sum(b"01FFWR0D999901"), "03"),
        (ModbusStation(holes=[("holding", 5, 5)]), bytes.fromhex("010300050001940b"), "04"),
    ],
    ids=["vigor", "computer-link", "modbus"],
)
def test_a_refusal_gets_another_code(
    station: VigorStation | ComputerLinkStation | ModbusStation, request_: bytes, code: str
) -> None:
    (usual,) = station.hear(request_, 0.0)
    assert is_unknown(station, usual)
    other = refusal(station, usual, code)
    assert not is_unknown(station, other)
    assert len(other) == len(usual)


def test_ranges_without_addresses() -> None:
    holes = Holes(frozenset({("D", 5)}), (("D", 10, 20),))
    assert ("D", 5) in holes
    assert ("D", 20) in holes
    assert ("D", 21) not in holes
    assert ("M", 15) not in holes
    assert not Holes(frozenset(), ())


@on_virtual_time
async def test_a_frozen_gateway_gets_the_bytes_first_and_the_timers_after_them() -> None:
    freezer, seen = Freezer(), list[tuple[str, float]]()
    freezer.install()

    class Port:
        def received(self, data: bytes) -> None:
            seen.append((data.decode(), now() - began))

        def lost(self, error: Exception) -> None:
            seen.append((str(error), now() - began))

    async def gateway() -> None:
        await asyncio.sleep(1.0)
        seen.append(("timer", now() - began))

    began = now()
    ear = Ear(freezer, Port())
    inside = asyncio.create_task(gateway(), context=freezer.inside())
    await asyncio.sleep(0.5)
    freezer.freeze()
    await asyncio.sleep(1.0)  # the world goes on
    ear.received(b"one, ")
    ear.received(b"two")
    await asyncio.sleep(1.0)
    freezer.thaw()
    await inside
    assert [(what, round(at, 3)) for what, at in seen] == [("one, two", 2.5), ("timer", 2.5)]


def test_a_campaign_continues_where_it_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    result = str(tmp_path / "lean.jsonl")
    chosen = ["campaign", "--hours", "0.01", "--pace", "lean", "--workers", "1"]
    monkeypatch.setattr("sys.argv", [*chosen, "--seeds", "0", "--result", result])
    assert campaign.main() == 0
    monkeypatch.setattr("sys.argv", [*chosen, "--seeds", "0-1", "--result", result])
    assert campaign.main() == 0
    assert "1 seeds in " in capsys.readouterr().out
    monkeypatch.setattr("sys.argv", ["campaign", "--total", result])
    assert campaign.main() == 0
    assert capsys.readouterr().out.startswith("lean: 2 seeds, 0.02 hours")


def test_an_error_of_an_engine_is_in_the_total_of_a_campaign(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fails(*_: object) -> NoReturn:
        raise IndexError("no first entry")

    monkeypatch.setattr(Engine, "conclude", fails)
    story = run(0, 0.01, "lean")
    assert set(story.rules()) == {"internal error"}
    total = campaign.Total()
    total.add(story)
    errors = story.counts["internal errors"]
    assert errors > 0
    assert f" {errors} internal errors, 1 seeds with a broken rule" in str(total)


DONE = WriteResult(1, 0, 0.1)
LATER = Unclear(f"not acknowledged within 8 s: it {MAY_COME}")


@pytest.mark.parametrize(
    ("end", "obeyed", "own"),
    [
        (DONE, 2, 1),  # the older one, then this one
        (DONE, 3, 2),  # one of them twice
        (DONE, 1, 1),
        (Busy("not sent"), 1, 0),  # the older one
        (Busy("not sent"), 2, 1),
    ],
)
def test_a_transfer_that_may_yet_be_done_is_no_second_write(
    end: WriteResult | GatewayError, obeyed: int, own: int
) -> None:
    """`hostile` seed 2700022."""
    rule = TransferRule(number=1, source="a/x", target="b/y", text=("a/x", "b/y"))
    row = Row(rule, make_tag("D1"))
    assert row.own(LATER, 0) == 0
    assert row.own(end, obeyed) == own
    assert row.own(DONE, 2) == 2  # nothing of before is open any more
