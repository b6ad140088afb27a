"""A port of datagrams: whole frames alone, and a device that is not there."""

import asyncio
import socket
from collections.abc import Iterator
from typing import Any

import pytest

from gateway.errors import LineDown
from gateway.transport import SerialSettings, UdpAddress, open_port
from gateway.transport.stream import MOST_AT_ONCE
from tests.transport.ends import RecordingReceiver

ANY = SerialSettings()
REQUEST = bytes.fromhex("00 01 0000 0006 01 03 0000 0001")
REPLY = bytes.fromhex("00 01 0000 0005 01 03 02 0007")


@pytest.fixture
def device() -> Iterator[socket.socket]:
    """A socket that is asked."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as found:
        found.bind(("127.0.0.1", 0))
        found.setblocking(False)
        yield found


async def asked(device: socket.socket) -> tuple[Any, ...]:
    data, by = await asyncio.get_running_loop().sock_recvfrom(device, 1000)
    assert data == REQUEST
    found: tuple[Any, ...] = by
    return found


async def test_each_datagram_is_a_frame_and_a_part_of_one_is_dropped(
    device: socket.socket,
) -> None:
    receiver = RecordingReceiver()
    port = await open_port(UdpAddress(*device.getsockname()), ANY, receiver)
    port.write(REQUEST)
    by = await asked(device)
    for datagram in (b"", REPLY[:5], REPLY[:-1], REPLY + b"\x00", REPLY):
        device.sendto(datagram, by)
    await receiver.until(lambda one: bool(one.data))
    assert (receiver.data, receiver.losses) == (REPLY, [])
    await port.close()
    with pytest.raises(LineDown, match="closed"):
        port.write(REQUEST)
    assert receiver.losses == []


async def test_another_sender_is_not_heard(device: socket.socket) -> None:
    receiver = RecordingReceiver()
    port = await open_port(UdpAddress(*device.getsockname()), ANY, receiver)
    port.write(REQUEST)
    by = await asked(device)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.sendto(REPLY[:-1] + b"\x63", by)
    device.sendto(REPLY, by)
    await receiver.until(lambda one: bool(one.data))
    assert receiver.data == REPLY
    await port.close()


async def test_a_port_that_nobody_has_is_refused(device: socket.socket) -> None:
    receiver, where = RecordingReceiver(), device.getsockname()
    device.close()
    port = await open_port(UdpAddress(*where), ANY, receiver)
    port.write(REQUEST)
    await receiver.until(lambda one: bool(one.losses))
    [loss] = receiver.losses
    assert str(loss) == f"127.0.0.1:{where[1]}: connection refused"
    with pytest.raises(LineDown, match="connection refused"):
        port.write(REQUEST)
    await port.close()


async def test_a_device_that_pours_loses_the_port(device: socket.socket) -> None:
    receiver = RecordingReceiver()
    port = await open_port(UdpAddress(*device.getsockname()), ANY, receiver)
    port.write(REQUEST)
    by, whole = await asked(device), REPLY[:4] + (1000).to_bytes(2, "big") + bytes(1000)
    for _ in range(10 * MOST_AT_ONCE // len(whole)):
        await asyncio.get_running_loop().sock_sendto(device, whole, by)
        await asyncio.sleep(0)
        if receiver.losses:
            break
    await receiver.until(lambda one: bool(one.losses))
    assert "pours" in str(receiver.losses)
    await port.close()


async def test_a_host_without_an_address_is_told() -> None:
    with pytest.raises(LineDown, match=r"^no\.such\.invalid:502: "):
        await open_port(UdpAddress("no.such.invalid", 502), ANY, RecordingReceiver())
