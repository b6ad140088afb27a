"""A local serial port: opened exclusively, its loss reported once."""

import asyncio
import subprocess
import sys
import tempfile
import termios
import threading
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest

from gateway.errors import LineDown
from gateway.transport import SerialPath, SerialSettings, open_port
from tests.conftest import needs
from tests.transport.ends import PATIENCE, PtyMaster, RecordingReceiver
from tests.vectors import vectors

REQUEST, REPLY = (vector.frame for vector in vectors("vigor")[:2])
SEVEN_EVEN = SerialSettings(19200, "7E1")


@pytest.fixture
def plug() -> Iterator[PtyMaster]:
    master = PtyMaster()
    yield master
    master.unplug()


def open_files() -> set[str]:
    """Returns the open files of this process, by number and name."""
    found = set()
    for entry in Path("/proc/self/fd").iterdir():
        try:
            found.add(f"{entry.name} {entry.readlink()}")
        except FileNotFoundError:
            continue  # the listing's own
    return found


async def test_bytes_pass_both_ways_at_7e1(plug: PtyMaster) -> None:
    receiver = RecordingReceiver()
    port = await open_port(SerialPath(plug.path), SEVEN_EVEN, receiver)
    port.write(REQUEST)
    assert await plug.read(len(REQUEST)) == REQUEST
    plug.write(REPLY)
    await receiver.until(lambda r: len(r.data) >= len(REPLY))
    assert receiver.data == REPLY
    await port.close()
    assert receiver.losses == []


async def test_every_byte_value_passes_at_8n1(plug: PtyMaster) -> None:
    receiver = RecordingReceiver()
    port = await open_port(SerialPath(plug.path), SerialSettings(9600, "8N1"), receiver)
    everything = bytes(range(256))
    port.write(everything)
    assert await plug.read(256) == everything
    plug.write(everything)
    await receiver.until(lambda r: len(r.data) >= 256)
    assert receiver.data == everything
    await port.close()


@pytest.mark.parametrize(
    ("settings", "speed", "stop_bits"),
    [
        (SerialSettings(9600, "8N1"), termios.B9600, 0),
        (SerialSettings(19200, "8N2"), termios.B19200, termios.CSTOPB),
        (SerialSettings(115200, "7E2"), termios.B115200, termios.CSTOPB),
    ],
)
async def test_speed_and_stop_bits_are_set(
    plug: PtyMaster, settings: SerialSettings, speed: int, stop_bits: int
) -> None:
    # Data bits and parity cannot be seen on a pty: it has always 8 and none.
    port = await open_port(SerialPath(plug.path), settings, RecordingReceiver())
    flags, set_speed = plug.format()
    assert set_speed == speed
    assert flags & termios.CSTOPB == stop_bits
    await port.close()


async def test_a_port_in_use_is_refused_until_it_is_closed(plug: PtyMaster) -> None:
    first = await open_port(SerialPath(plug.path), SEVEN_EVEN, RecordingReceiver())
    with pytest.raises(LineDown, match=f"^{plug.path}: in use by another program$"):
        await open_port(SerialPath(plug.path), SEVEN_EVEN, RecordingReceiver())
    await first.close()
    second = await open_port(SerialPath(plug.path), SEVEN_EVEN, RecordingReceiver())
    await second.close()


@pytest.mark.parametrize(
    ("path", "sentence"),
    [
        ("/dev/ttyNOTHERE", "no such port"),
        ("/dev/null/tty", "no such port"),
        ("/dev/null", "not a serial port"),
        ("/tmp", "not a serial port"),
    ],
)
async def test_a_path_without_a_serial_port_is_explained(path: str, sentence: str) -> None:
    with pytest.raises(LineDown) as caught:
        await open_port(SerialPath(path), SEVEN_EVEN, RecordingReceiver())
    assert str(caught.value) == f"{path}: {sentence}"


OPEN_WITHOUT_RIGHTS = """
import asyncio, os, sys
from gateway.errors import LineDown
from gateway.transport import SerialPath, SerialSettings, open_port

async def told(path):
    try:
        await open_port(SerialPath(path), SerialSettings(), None)
    except LineDown as error:
        return str(error)

asyncio.run(told("/dev/null"))  # imports all modules while root may still read them
if os.geteuid() == 0:  # root may open everything
    os.setgroups([])
    os.setgid(65534)
    os.setuid(65534)
print(asyncio.run(told(sys.argv[1])))
"""


def test_permission_denied_names_the_group() -> None:
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        closed = Path(folder) / "tty"
        closed.touch(mode=0)
        command = [sys.executable, "-c", OPEN_WITHOUT_RIGHTS, str(closed)]
        said = subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()
    assert said == f"{closed}: permission denied: is the user in group dialout?"


@pytest.mark.parametrize("path", ["a\0b", "x" * 5000])
async def test_an_invalid_path_is_line_down(path: str) -> None:
    with pytest.raises(LineDown):
        await open_port(SerialPath(path), SEVEN_EVEN, RecordingReceiver())


async def test_a_pty_can_be_opened_as_7e1_again_and_again(plug: PtyMaster) -> None:
    # Linux refuses 7 bits and parity on a pty from the second time on.
    for _ in range(3):
        port = await open_port(SerialPath(plug.path), SEVEN_EVEN, RecordingReceiver())
        await port.close()


async def test_unplugging_is_reported_once_and_later_writes_fail(plug: PtyMaster) -> None:
    receiver = RecordingReceiver()
    port = await open_port(SerialPath(plug.path), SEVEN_EVEN, receiver)
    plug.unplug()
    await receiver.until(lambda r: bool(r.losses))
    with pytest.raises(LineDown, match="unplugged"):
        port.write(REQUEST)
    await port.close()
    await port.close()
    assert [type(error) for error in receiver.losses] == [LineDown]


async def test_a_write_during_the_unplugging_fails(plug: PtyMaster) -> None:
    receiver = RecordingReceiver()
    port = await open_port(SerialPath(plug.path), SEVEN_EVEN, receiver)
    plug.unplug()
    with pytest.raises(LineDown):  # before the loop notices
        port.write(REQUEST)
    await receiver.until(lambda r: bool(r.losses))
    await port.close()
    assert len(receiver.losses) == 1


async def test_nothing_is_reported_after_close(plug: PtyMaster) -> None:
    receiver = RecordingReceiver()
    port = await open_port(SerialPath(plug.path), SEVEN_EVEN, receiver)
    await asyncio.gather(port.close(), port.close())
    plug.unplug()
    with pytest.raises(LineDown):
        port.write(REQUEST)
    await asyncio.sleep(0)
    assert (receiver.data, receiver.losses) == (b"", [])


async def test_a_port_that_accepts_no_data_is_down_and_keeps_no_old_requests(
    plug: PtyMaster,
) -> None:
    receiver = RecordingReceiver()
    port = await open_port(SerialPath(plug.path), SEVEN_EVEN, receiver)

    def keep_writing() -> None:
        for _ in range(1000):  # the pty is not read
            port.write(REQUEST * 10)

    with pytest.raises(LineDown, match="accepts no data"):
        keep_writing()
    await receiver.until(lambda r: bool(r.losses))
    await port.close()
    assert len(receiver.losses) == 1


async def test_bytes_from_before_the_opening_are_discarded(plug: PtyMaster) -> None:
    plug.write(REPLY)
    receiver = RecordingReceiver()
    port = await open_port(SerialPath(plug.path), SEVEN_EVEN, receiver)
    plug.write(REQUEST)
    await receiver.until(lambda r: len(r.data) >= len(REQUEST))
    assert receiver.data == REQUEST
    await port.close()


async def test_opening_and_closing_leaves_nothing_behind(plug: PtyMaster) -> None:
    await (await open_port(SerialPath(plug.path), SEVEN_EVEN, RecordingReceiver())).close()
    files, tasks, threads = open_files(), asyncio.all_tasks(), {*threading.enumerate()}
    for _ in range(5):
        port = await open_port(SerialPath(plug.path), SEVEN_EVEN, RecordingReceiver())
        with pytest.raises(LineDown):
            await open_port(SerialPath(plug.path), SEVEN_EVEN, RecordingReceiver())
        await port.close()
    assert open_files() == files
    await asyncio.sleep(0)
    assert asyncio.all_tasks() == tasks
    # Only the loop's own executor, whose threads end with the loop.
    started = {*threading.enumerate()} - threads
    assert all(thread.name.startswith("asyncio_") for thread in started)


async def test_a_cancelled_opening_closes_the_port(plug: PtyMaster) -> None:
    files = open_files()
    opening = asyncio.create_task(open_port(SerialPath(plug.path), SEVEN_EVEN, RecordingReceiver()))
    await asyncio.sleep(0)
    opening.cancel()
    with pytest.raises(asyncio.CancelledError):
        await opening
    assert open_files() == files


@pytest.fixture
async def cable(tmp_path: Path) -> AsyncIterator[tuple[str, str, asyncio.subprocess.Process]]:
    """Two ports with a cable between them."""
    program = needs("socat")
    ends = str(tmp_path / "a"), str(tmp_path / "b")
    socat = await asyncio.create_subprocess_exec(
        program, "-d", "-d", *(f"pty,raw,echo=0,link={end}" for end in ends),
        stderr=asyncio.subprocess.PIPE,
    )  # fmt: skip
    assert socat.stderr is not None
    async with asyncio.timeout(PATIENCE):
        while b"starting data transfer" not in await socat.stderr.readline():
            pass
    yield *ends, socat
    if socat.returncode is None:
        socat.terminate()
    await socat.communicate()


async def test_two_ports_on_a_cable_and_the_cable_pulled(
    cable: tuple[str, str, asyncio.subprocess.Process],
) -> None:
    left, right, socat = cable
    receivers = RecordingReceiver(), RecordingReceiver()
    ports = [
        await open_port(SerialPath(path), SEVEN_EVEN, receiver)
        for path, receiver in zip((left, right), receivers, strict=True)
    ]
    ports[0].write(REQUEST)
    await receivers[1].until(lambda r: len(r.data) >= len(REQUEST))
    ports[1].write(REPLY)
    await receivers[0].until(lambda r: len(r.data) >= len(REPLY))
    assert (receivers[1].data, receivers[0].data) == (REQUEST, REPLY)
    socat.terminate()
    for receiver, port in zip(receivers, ports, strict=True):
        await receiver.until(lambda r: bool(r.losses))
        with pytest.raises(LineDown):
            port.write(REQUEST)
        await port.close()
        assert len(receiver.losses) == 1
