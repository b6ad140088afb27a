"""Integers of 64 bits with scale and offset, from the PLC to the client and back."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.e2e.processes import (
    Program,
    plc_gateway,
    started,
    station,
    vigor_line,
    write_config,
)
from tests.zenoh_peer import ZenohPeer, free_endpoint

HELD, ENERGY = 2**53 + 1, 2**51 + 1
TAGS = {
    "counter": {"address": "D500", "type": "int64", "offset": 5, "write": True},
    "energy": {"address": "D504", "type": "uint64", "scale": 0.01, "write": True},
    "origin": {"address": "D508", "type": "int64", "offset": -HELD, "write": {"max": HELD}},
}


class Meter(NamedTuple):
    plc: Program
    endpoint: str
    config: Path


@pytest.fixture(scope="module")
def meter(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Meter]:
    folder, endpoint = tmp_path_factory.mktemp("meter"), free_endpoint()
    line = vigor_line(str(folder / "tty"), TAGS)
    config = write_config(folder / "config.yaml", endpoint, {"hall": line})
    with station("pty", str(folder / "tty")) as plc:
        for first, held in ((500, HELD), (504, ENERGY), (508, HELD)):
            for n in range(4):
                plc.tell(f"set 1 D {first + n} {held >> 16 * n & 0xFFFF}")
        with started(config):
            yield Meter(plc, endpoint, config)


@pytest.mark.parametrize(
    ("tag", "text"),
    [
        ("counter", f"{HELD + 5}"),
        ("energy", "22517998136852.49"),
        ("origin", "0"),
    ],
)
async def test_no_digit_of_a_read_value_is_lost(meter: Meter, tag: str, text: str) -> None:
    async with ZenohPeer("client", connect=[meter.endpoint]) as client:
        [reply] = await client.get(f"plant/mixer/{tag}?max_age=0s")
    assert f'"value":{text},' in reply.payload.decode()


@pytest.mark.parametrize("form", ["{}", "{}.0"])
async def test_no_digit_of_a_written_value_is_lost(meter: Meter, form: str) -> None:
    wanted = HELD + 15
    async with ZenohPeer("client", connect=[meter.endpoint]) as client:
        [reply] = await client.get("plant/mixer/counter/@set", form.format(wanted).encode())
    assert reply.json["value"] == wanted
    words = [int(meter.plc.tell(f"get 1 D {500 + n}")) for n in range(4)]
    assert sum(word << 16 * n for n, word in enumerate(words)) == wanted - 5


def test_check_says_what_a_json_number_cannot_carry(meter: Meter) -> None:
    notes = [line for line in plc_gateway("check", meter.config).err.splitlines() if "note" in line]
    assert len(notes) == 2
    assert "mixer/energy (D504): a JSON number has 53 bits. Beyond 3.518e+13" in notes[0]
