"""Masters on the wire of a running gateway, and a client on Zenoh in another process."""

import asyncio
import os
import select
import signal
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Self

from gateway.protocols.checksums import crc16
from gateway.protocols.vigor.codec import Reply, Request, encode
from tests.e2e.processes import free_port, started, write_config
from tests.serving.easy_link import EXAMPLE, EasyLink
from tests.zenoh_peer import Subscription, ZenohPeer, free_endpoint

TAGS = {
    "speed": {"address": "holding:0", "type": "int16", "source": "mixer/speed"},
    "limit": {"address": "holding:1", "write": {"max": 50}, "retain": True},
    "order": {"address": "holding:100", "type": "uint32"},
}
STATION = {"station": 1, "accept": ["holding:100..holding:109"], "stale_after": "300ms"}
PAUSES = 0.06, 0.1  # seconds between the pieces of a request
MIXER = {"speed": {"address": "D100", "write": True, "every": "50ms"}}


class Wire:
    """The master's end of a pty."""

    def __init__(self) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        os.close(self._master)
        os.close(self._slave)

    def say(self, data: bytes) -> None:
        os.write(self._master, data)

    @contextmanager
    def heard_by(self, take: Callable[[bytes], None]) -> Iterator[None]:
        """Passes on what arrives."""
        loop = asyncio.get_running_loop()
        loop.add_reader(self._master, lambda: take(os.read(self._master, 4096)))
        try:
            yield
        finally:
            loop.remove_reader(self._master)

    async def ask(self, request: bytes, size: int) -> bytes:
        """Returns so many bytes of the reply."""
        loop = asyncio.get_running_loop()
        self.say(request)
        reply = b""
        async with asyncio.timeout(300):
            while len(reply) < size:
                readable = asyncio.Event()
                loop.add_reader(self._master, readable.set)
                await readable.wait()
                loop.remove_reader(self._master)
                reply += os.read(self._master, 4096)
        return reply

    def exchange(self, request: bytes) -> bytes:
        """Returns one reply that ends with ETX and a sum; blocks."""
        self.say(request)
        reply = b""
        while b"\x03" not in reply[:-2]:
            assert select.select([self._master], [], [], 5)[0], f"only {reply!r}"
            reply += os.read(self._master, 4096)
        return reply


class Tcp:
    """A master on Modbus TCP."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader, self._writer = reader, writer

    async def ask(self, pdu: str) -> str:
        data = b"\x01" + bytes.fromhex(pdu)
        self._writer.write(bytes(4) + len(data).to_bytes(2, "big") + data)
        async with asyncio.timeout(300):
            head = await self._reader.readexactly(6)
            reply = await self._reader.readexactly(int.from_bytes(head[4:], "big"))
        return reply[1:].hex(" ")

    async def close(self) -> None:
        self._writer.close()
        await self._writer.wait_closed()


def rtu(text: str) -> bytes:
    body = bytes.fromhex(text)
    return body + crc16(body)


def _plant(folder: Path, endpoint: str, number: int, *ttys: str) -> Path:
    served: dict[str, Any] = {"serve": True}
    panel = {**STATION, "protocol": "modbus-tcp", "tags": TAGS}
    plc = {**STATION, "protocol": "modbus-rtu", "stale_after": "1h"}
    plc["tags"] = {"order": TAGS["order"]}
    words = {f"d{n}": {"address": f"D{n}", "source": "mixer/speed"} for n in range(10, 20)}
    bits = {f"m{n}": {"address": f"M{n}"} for n in range(100, 130)}
    five = {"protocol": "vigor", "station": 5, "tags": words}
    two = {"protocol": "vigor", "station": 2, "accept": ["M100..M129"], "tags": bits}
    liyan = {"protocol": "computer-link", "frame_format": 4, "station": 3, "accept": ["D0000"]}
    liyan["tags"] = {"order": {"address": "D0000"}}
    mixer = {"protocol": "vigor", "station": 1, "tags": MIXER}
    return write_config(
        folder / "config.yaml",
        endpoint,
        {
            "hall": {"port": "simulator", "devices": {"mixer": mixer}},
            "panel": {"port": f"tcp://127.0.0.1:{number}", **served, "devices": {"hmi": panel}},
            "wire": {"port": ttys[0], "baudrate": 19200, **served, "devices": {"plc": plc}},
            "link": {"port": ttys[1], **served, "devices": {"five": five, "two": two}},
            "lnk485": {"port": ttys[2], **served, "devices": {"liyan": liyan}},
        },
        gateway={"name": "demo", "state": "state.json"},
    )


def _values(seen: Subscription, key: str) -> list[Any]:
    return [one.json["value"] for one in seen.samples if one.key == key]


async def test_a_master_and_a_client_exchange_values(tmp_path: Path) -> None:
    endpoint, number = free_endpoint(), free_port()
    with Wire() as wire, Wire() as link, Wire() as lnk485:
        path = _plant(tmp_path, endpoint, number, wire.path, link.path, lnk485.path)
        with started(path) as program:
            async with ZenohPeer("client", connect=[endpoint]) as client:
                seen = await client.subscribe("plant/**")
                for line in ("wire", "link", "lnk485"):
                    program.says("line open", f"line={line}")
                panel = Tcp(*await asyncio.open_connection("127.0.0.1", number))
                # What the master writes is published once, and with one time.
                assert await wire.ask(rtu("01 10 0064 0002 04 0001 0002"), 8) == rtu(
                    "01 10 0064 0002"
                )
                for _ in range(2):
                    assert await panel.ask("10 0064 0002 04 0001 0000") == "10 00 64 00 02"
                assert await panel.ask("06 0000 0001") == "86 02"
                assert await panel.ask("06 0064 0001") == "86 02"  # one half
                # What a client writes is read, and so are the values of other PLCs.
                assert await panel.ask("03 0001 0001") == "83 04"
                [refused] = await client.get("plant/hmi/limit/@set", b"51")
                assert refused.json["error"] == "bad-value"
                [answer] = await client.get("plant/hmi/limit/@set", b"42")
                assert answer.json["value"] == 42
                assert await panel.ask("03 0001 0001") == "03 02 00 2a"
                [answer] = await client.get("plant/mixer/speed/@set", b"258")
                await seen.next(lambda one: one.key.endswith("speed") and one.json["value"] == 258)
                assert await panel.ask("03 0000 0001") == "03 02 01 02"
                # Easy Link, with the table of the manual, and an EX485LNK.
                master = EasyLink(link.exchange)
                master.devices = {(3, n): n % 2 for n in range(30)}
                assert await asyncio.to_thread(master.perform, EXAMPLE) == ["00", "00"]
                assert [master.devices[13, n] for n in range(10)] == [258] * 10
                await seen.next(lambda one: one.key == "plant/two/m129" and one.json["value"])
                assert _values(seen, "plant/two/m128")[-1:] == [False]
                write = b"\x0503FFWW0D0000011234"
                write += b"%02X\r\n" % (sum(write[1:]) & 0xFF)
                assert await lnk485.ask(write, 7) == b"\x0603FF\r\n"
                await seen.next(
                    lambda one: one.key == "plant/liyan/order" and one.json["value"] == 0x1234
                )
                # A silent master.
                await seen.next(
                    lambda one: one.key == "plant/hmi/order" and one.json["value"] is None
                )
                orders = _values(seen, "plant/hmi/order")
                assert (orders.count(1), orders[-1]) == (2, None)
                assert _values(seen, "plant/plc/order")[-1:] == [0x20001]
                device = await client.get_until(
                    "plant/@gateway/demo/devices/hmi", lambda one: one["standing"] == "silent"
                )
                assert device["refusals"] == {"02": 2, "04": 1}
                await panel.close()
            assert program.end(signal.SIGKILL) == -signal.SIGKILL
        with started(path) as program:
            program.says("line open", "line=panel")
            panel = Tcp(*await asyncio.open_connection("127.0.0.1", number))
            assert await panel.ask("03 0001 0001") == "03 02 00 2a"
            assert await panel.ask("03 0064 0002") == "83 04"
            await panel.close()
            assert program.end() == 0


async def answered_in_pieces(wire: Wire, request: bytes, reply: bytes) -> bool:
    """Asks in three pieces. A machine that is busy may make a pause too long: asks some times."""
    third = len(request) // 3
    pieces = request[:third], request[third : 2 * third], request[2 * third :]
    received, whole = b"", asyncio.Event()

    def take(data: bytes) -> None:
        nonlocal received
        received += data
        if received.endswith(reply):
            whole.set()

    with wire.heard_by(take):
        for _ in range(10):
            wire.say(pieces[0])
            for pause, piece in zip(PAUSES, pieces[1:], strict=True):
                await asyncio.sleep(pause)
                wire.say(piece)
            with suppress(TimeoutError):
                await asyncio.wait_for(whole.wait(), 3)
                return True
    return False


async def test_requests_in_pieces_are_answered_at_300_baud(tmp_path: Path) -> None:
    order = {"order": {"address": "D100"}}
    vigor = {"protocol": "vigor", "station": 1, "accept": ["D100"], "tags": order}
    plc = {"protocol": "modbus-rtu", **STATION, "tags": {"order": {"address": "holding:100"}}}
    slow = {"baudrate": 300, "serve": True}
    with Wire() as wire, Wire() as link:
        lines = {
            "wire": {"port": wire.path, **slow, "devices": {"plc": plc}},
            "link": {"port": link.path, **slow, "devices": {"vigor": vigor}},
        }
        file = write_config(tmp_path / "config.yaml", free_endpoint(), lines)
        with started(file) as program:
            for line in lines:
                program.says("line open", f"line={line}")
            for number in range(3):
                write = rtu(f"01 06 0064 000{number}")
                assert await answered_in_pieces(wire, write, write)
                body = b"1CC802%02X00" % number
                done = encode(Reply(1, "61", "00"))
                assert await answered_in_pieces(link, encode(Request(1, "61", body)), done)
