"""The drivers without a gateway: the program of docs/library.md at a simulated PLC."""

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from gateway.errors import Garbled, NoReply, Refused
from gateway.protocols.driver import Span
from gateway.protocols.exchange import exchange
from gateway.protocols.modbus import ModbusTcp
from gateway.protocols.vigor import Vigor
from gateway.stations.vigor import VigorStation
from tests.e2e.processes import ROOT, station

PAGE = (ROOT / "docs/library.md").read_text("utf-8")
D100 = Span("D", 100, 2)


class Wire:
    """A PLC at the end of two functions; it replies to each request at once."""

    def __init__(self, plc: VigorStation | None = None) -> None:
        self.plc = plc or VigorStation(1)
        self.before = b""
        self._replies: Iterator[bytes] = iter(())

    def send(self, data: bytes) -> None:
        received = self.before + b"".join(self.plc.hear(data, 0.0))
        self._replies = (received[at : at + 1] for at in range(len(received)))

    def receive(self) -> bytes:
        return next(self._replies, b"")


def read(wire: Wire, span: Span = D100) -> list[int]:
    plc = Vigor(station=1)
    return list(exchange(plc, lambda talk: plc.read(talk, span), wire.send, wire.receive))


def test_ten_lines_read_a_plc(tmp_path: Path) -> None:
    [program] = re.findall(r"^```python\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    [shown] = re.findall(r"^```text\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    assert len([line for line in program.splitlines() if line]) <= 10
    link = tmp_path / "port"
    with station("pty", str(link)) as plc:
        for number, value in enumerate((12, 0, 65535, 7)):
            plc.tell(f"set 1 D {100 + number} {value}")
        text = program
        for old, new in (("/dev/ttyUSB0", str(link)), ("timeout=0.5", "timeout=60")):
            assert text.count(old) == 1
            text = text.replace(old, new)  # a slow machine replies late
        done = subprocess.run(
            [sys.executable, "-c", text], cwd=ROOT, capture_output=True, text=True, check=True
        )
    assert done.stdout == shown


def test_words_are_written_and_read_back() -> None:
    wire, plc = Wire(), Vigor(station=1)
    assert exchange(plc, lambda talk: plc.write(talk, D100, [7, 65535]), wire.send, wire.receive)
    assert read(wire) == [7, 65535]


def test_the_reply_of_another_station_is_skipped_and_noise_too() -> None:
    wire, other, requests = Wire(), VigorStation(2), list[bytes]()
    plc = Vigor(station=2)
    with pytest.raises(NoReply):
        exchange(plc, lambda talk: plc.read(talk, D100), requests.append, lambda: b"")
    wire.before = b"\xff\x00" + b"".join(other.hear(requests[0], 0.0))
    wire.plc.memory.write("D", 100, [3, 4])
    assert read(wire) == [3, 4]


def test_faults_are_those_of_the_driver() -> None:
    wire = Wire()
    wire.plc.mute = True
    with pytest.raises(NoReply):
        read(wire)
    wire.before = b"\x06015100AB\x0300"
    with pytest.raises(Garbled):
        read(wire)
    with pytest.raises(Refused):
        read(Wire(VigorStation(1, holes=[("D", 100)])))


def test_noise_without_an_end_ends_the_transaction() -> None:
    plc = Vigor(station=1)
    with pytest.raises(NoReply, match="bytes without an end"):
        exchange(plc, lambda talk: plc.read(talk, D100), lambda _: None, lambda: b"\xff")


def test_a_resync_is_an_exchange_too() -> None:
    wire, plc = Wire(), Vigor(station=1)
    assert exchange(plc, lambda talk: plc.resync(talk, D100, 3), wire.send, wire.receive) > 0


def test_modbus_is_used_in_the_same_way() -> None:
    meter, sent = ModbusTcp(station=1), list[bytes]()

    def receive() -> bytes:
        return sent[0][:2] + bytes.fromhex("0000 0005 01 03 02 002A")

    span = Span("holding", 10, 1)
    words = exchange(meter, lambda talk: meter.read(talk, span), sent.append, receive)
    assert list(words) == [42]
