"""The no-protocol examples, unchanged, over a pty with a peer of plain bytes.

Gateway and Zenoh client are processes; the device is a thread on the far end of the pty.
"""

import json
import os
import select
import threading
import tty
from collections.abc import Callable
from pathlib import Path
from typing import Self

import pytest

from tests.e2e.processes import ROOT, plc_gateway, started
from tests.vectors import vectors
from tests.zenoh_peer import ZenohPeer, free_endpoint

K120S = {v.id: v.frame for v in vectors("noproto-k120s")}
# The A&D EK-L manual's data format, 9-2: header, sign, digits, unit, CR LF.
STABLE = b"ST,+001234.5  g\r\n"
OVERLOAD = b"OL,+999999.9  g\r\n"


class ByteDevice:
    """The far end of a pty: passes its input to `hear` and sends the result."""

    def __init__(
        self, hear: Callable[[bytes], bytes] = lambda _: b"", streams: bytes = b""
    ) -> None:
        """`streams`: sent ten times a second."""
        self._hear = hear
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self.streams = streams
        self.heard = b""
        self._end, self._wake = os.pipe()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_error: object) -> None:
        os.write(self._wake, b"x")
        self._thread.join()
        for number in (self._master, self._slave, self._end, self._wake):
            os.close(number)

    def say(self, data: bytes) -> None:
        os.write(self._master, data)

    def _run(self) -> None:
        while True:
            ready, _, _ = select.select([self._master, self._end], [], [], 0.1)
            if self._end in ready:
                return
            if self._master in ready:
                data = os.read(self._master, 1024)
                self.heard += data
                if answer := self._hear(data):
                    self.say(answer)
            elif self.streams:
                self.say(self.streams)


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


def configured(folder: Path, name: str, port: str, endpoint: str) -> Path:
    """Writes the example with another port and endpoint."""
    text = (ROOT / "examples" / f"{name}.yaml").read_text()
    for old, new in (("/dev/ttyUSB0", port), ("tcp/127.0.0.1:7447", endpoint)):
        assert text.count(old) == 1
        text = text.replace(old, new)
    if name == "inverter":  # this process plays it
        text = text.replace("protocol: frames", "protocol: frames\n        reply_timeout: 5s")
    path = folder / "plant.yaml"
    path.write_text(text)
    return path


async def test_a_scale_streams_weights(tmp_path: Path, endpoint: str) -> None:
    with ByteDevice(streams=STABLE) as scale:
        config = configured(tmp_path, "scale", scale.port, endpoint)
        assert plc_gateway("check", config).code == 0
        read = plc_gateway("read", config, "--direct", "--json")
        rows = {row["tag"]: row for row in map(json.loads, read.out.splitlines())}
        assert read.code == 0, read
        assert rows["scale/weight"]["value"] == 1234.5
        assert rows["scale/state"]["value"] == "ST"
        with started(config):
            async with ZenohPeer("client", connect=[endpoint]) as client:
                heard = await client.subscribe("plant/scale/**")
                await client.until_alive(
                    "plant/@gateway/*/alive/*", ["plant/@gateway/weighing-room/alive/scale"]
                )
                [reply] = await client.get("plant/scale/weight")
                assert reply.json["value"] == 1234.5
                scale.streams = OVERLOAD
                await heard.next(
                    lambda s: s.key.endswith("weight") and s.json.get("reason") == "garbled"
                )
                heard.forget()
                scale.streams = STABLE
                await heard.next(lambda s: s.key.endswith("weight") and s.json["quality"] == "good")
                scale.streams = b""
                await heard.next(
                    lambda s: s.key.endswith("weight") and s.json.get("reason") == "no-reply"
                )
                await client.until_alive("plant/@gateway/*/alive/*", [])
        assert scale.heard == b""


async def test_every_bar_code_is_an_event_even_if_read_twice(tmp_path: Path, endpoint: str) -> None:
    codes = ["4006381333931", "4006381333931", "A-17", "4006381333931"]
    with ByteDevice() as reader:
        config = configured(tmp_path, "barcode-reader", reader.port, endpoint)
        with started(config) as program:
            program.says("line open")  # what was said before would be lost
            async with ZenohPeer("client", connect=[endpoint]) as client:
                heard = await client.subscribe("plant/reader/barcode")
                reader.say(b"".join(b"\x02" + code.encode() + b"\x03" for code in codes))
                reader.say(b"\x02LAST\x03")
                await heard.next(lambda s: s.json["value"] == "LAST")
                values = [s.json["value"] for s in heard.samples if s.json["quality"] == "good"]
                assert values == [*codes, "LAST"]
                [reply] = await client.get("plant/reader/barcode")
                assert reply.json["value"] == "LAST"


def _frame(text: bytes) -> bytes:
    data = text + b"\x03"
    return b"\x02" + data + b"%02X" % (sum(data) % 256)


class _Inverter:
    """Replies to `F?` with the speed that was set last."""

    def __init__(self) -> None:
        self._rest = b""
        self.speed = b"049.98"

    def __call__(self, data: bytes) -> bytes:
        self._rest += data
        answer = b""
        while (end := self._rest.find(b"\x03")) >= 0 and len(self._rest) >= end + 3:
            frame, self._rest = self._rest[: end + 3], self._rest[end + 3 :]
            command = frame[1:end]
            assert frame == _frame(command), frame
            answer += self._answer(command)
        return answer

    def _answer(self, command: bytes) -> bytes:
        if command == b"F?":
            return _frame(b"F=" + self.speed)
        if command == b"S=013.00":
            return _frame(b"ER07")
        self.speed = command.removeprefix(b"S=")
        return _frame(b"OK")


async def test_an_inverter_is_read_and_written_by_ascii_commands(
    tmp_path: Path, endpoint: str
) -> None:
    with ByteDevice(_Inverter()) as inverter:
        config = configured(tmp_path, "inverter", inverter.port, endpoint)
        read = plc_gateway("read", config, "--direct", "inverter/frequency")
        assert "49.98" in read.out
        written = plc_gateway("write", config, "--direct", "inverter/setpoint", "25")
        assert (written.code, "acknowledged" in written.out) == (0, True)
        with started(config):
            async with ZenohPeer("client", connect=[endpoint]) as client:
                heard = await client.subscribe("plant/inverter/**")
                await client.until_alive(
                    "plant/@gateway/*/alive/*", ["plant/@gateway/drives/alive/inverter"]
                )
                [reply] = await client.get("plant/inverter/setpoint/@set", b"37.5")
                assert reply.ok, reply
                assert reply.json["value"] == 37.5
                await heard.next(lambda s: s.json["value"] == 37.5)  # as it says itself
                [reply] = await client.get("plant/inverter/setpoint/@set", b"13")
                assert (reply.json["error"], reply.json["code"]) == ("refused", "07")
                [reply] = await client.get("plant/inverter/setpoint/@set", b"60.01")
                assert reply.json["error"] == "bad-value"
    assert b"60.01" not in inverter.heard


async def test_the_k120s_weighing_example_is_answered(tmp_path: Path, endpoint: str) -> None:
    frame, answer = K120S["noproto-k120s-001"], K120S["noproto-k120s-002"]
    waiting = threading.Semaphore(0)

    def hear(data: bytes) -> bytes:
        for _ in range(data.count(answer[-1:])):
            waiting.release()
        return b""

    with ByteDevice(hear) as machine:
        config = configured(tmp_path, "weighing-machine", machine.port, endpoint)
        with started(config) as program:
            program.says("line open")  # what was said before would be lost
            async with ZenohPeer("client", connect=[endpoint]) as client:
                heard = await client.subscribe("plant/weighing/weight")
                for _ in range(3):
                    machine.say(frame)
                    assert waiting.acquire(timeout=300)
                machine.say(frame)
                await heard.until(
                    lambda s: (
                        [h.json["value"] for h in s.samples if h.json["value"]] == [0x3412] * 4
                    )
                )
                assert waiting.acquire(timeout=300)
        assert machine.heard == answer * 4
