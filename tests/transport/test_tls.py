"""TLS of connections: both loops, both sides, and a sentence for each certificate that is wrong."""

import asyncio
import socket
import ssl
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from threading import Thread

import pytest
from cryptography.x509 import load_pem_x509_certificate

from gateway.errors import LineDown
from gateway.transport import Port, SerialSettings, TcpAddress, open_port
from gateway.transport.asn1 import revoked_numbers
from gateway.transport.device_servers import close_doors
from gateway.transport.listen import Listener
from gateway.transport.loop import new_event_loop
from gateway.transport.port import DeviceServer, ListenAddress, TlsConfig
from gateway.transport.stream import StreamPort
from gateway.transport.tls import certificate_of, make_context
from tests.transport.authority import DAY, Authority
from tests.transport.ends import PATIENCE, RecordingReceiver, free_port

ANY = SerialSettings()
LOOPS = [asyncio.new_event_loop, new_event_loop]


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    return Authority(tmp_path_factory.mktemp("plant"))


def ours(plant: Authority, name: str = "gateway") -> TlsConfig:
    certificate, key = plant.issue(name)
    return TlsConfig(ca=plant.ca, certificate=certificate, key=key, mutual=True)


def foreign_server(certificate: Path, key: Path, ca: Path | None = None) -> ssl.SSLContext:
    """The context of a server that is not ours: the standard library alone."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    if ca is not None:
        context.load_verify_locations(ca)
        context.verify_mode = ssl.CERT_REQUIRED
    return context


@contextmanager
def serving(context: ssl.SSLContext | None) -> Iterator[int]:
    """A device server that echoes, on threads: asyncio's own sends no alert. Yields its port."""

    def echo(plain: socket.socket) -> None:
        with plain, suppress(OSError):
            plain.settimeout(PATIENCE)
            if context is None:  # the hello is no frame of Modbus: it closes the connection
                plain.recv(1000)
                return
            with context.wrap_socket(plain, server_side=True) as link:
                while data := link.recv(1000):
                    link.sendall(data)

    def accept() -> None:
        with suppress(OSError):
            while True:
                threads.append(Thread(target=echo, args=[server.accept()[0]]))
                threads[-1].start()

    threads = list[Thread]()
    with socket.create_server(("127.0.0.1", 0)) as server:
        accepting = Thread(target=accept)
        accepting.start()
        try:
            yield server.getsockname()[1]
        finally:
            server.shutdown(socket.SHUT_RDWR)
            for one in (accepting, *threads):
                one.join()


@pytest.mark.parametrize("loop", LOOPS)
def test_bytes_pass_over_tls_and_the_end_is_reported_once(
    plant: Authority, loop: Callable[[], asyncio.AbstractEventLoop]
) -> None:
    certificate, key = plant.issue("device")

    async def play() -> None:
        heard = RecordingReceiver()
        with serving(foreign_server(certificate, key, plant.ca)) as number:
            where = TcpAddress("127.0.0.1", number, ours(plant))
            port = await open_port(where, ANY, heard, timeout=PATIENCE)
            everything = bytes(range(256))
            port.write(everything)
            await heard.until(lambda r: r.data == everything)
            assert isinstance(port, StreamPort)
            assert b"device" in certificate_of(port)
            await port.close()
            with pytest.raises(LineDown):
                port.write(b"!")
        assert heard.losses == []

    with asyncio.Runner(loop_factory=loop) as runner:
        runner.run(play())


async def refusal(where: TcpAddress) -> str:
    """Returns why a connection is not opened, or is lost at once."""
    heard = RecordingReceiver()
    try:
        port = await open_port(where, ANY, heard, timeout=PATIENCE)
        await heard.until(lambda r: bool(r.losses))  # TLS 1.3: the server speaks last
        await port.close()
    except LineDown as error:
        return str(error).partition(": ")[2]
    return str(heard.losses[0]).partition(": ")[2]


def of_device(plant: Authority, other: Authority, wrong: str) -> tuple[Path, Path]:
    match wrong:
        case "expired":
            return plant.issue("device", left=-DAY)
        case "self-signed":
            return plant.issue("device", self_signed=True)
        case "other authority":
            return other.issue("device")
        case "other address":
            return plant.issue("device", names=("localhost",))
    return plant.issue("device")


def of_gateway(plant: Authority, other: Authority, wrong: str, device: Path) -> TlsConfig:
    tls = ours(plant)
    match wrong:
        case "revoked":
            return replace(tls, revoked=plant.revoke(device))
        case "old list":
            return replace(tls, revoked=plant.revoke(left=-DAY))
        case "other name":
            return replace(tls, name="plc-7.plant")
        case "ours missing":
            return TlsConfig(ca=plant.ca)
        case "no file":
            return replace(tls, ca=plant.folder / "nowhere.pem")
        case "half renewed":
            return replace(tls, key=plant.issue("other")[1])
    left = -DAY if wrong == "ours expired" else DAY
    certificate, key = (other if wrong == "ours unknown" else plant).issue("gateway", left=left)
    return replace(tls, certificate=certificate, key=key)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ("expired", "its certificate has expired: renew it there, or correct the clock here"),
        ("self-signed", "its certificate is self-signed: give it one of the authority, or name it"),
        ("other authority", "the authority of its certificate is not the one of `tls: ca`"),
        ("revoked", "its certificate is revoked by `tls: revoked`: give it a new one"),
        ("old list", "the list of `tls: revoked` has expired: fetch the new one"),
        ("other name", "its certificate has another name: if it is the right device, write that"),
        ("other address", "its certificate has another address: write a name of it as `tls: name`"),
        ("no TLS", "TLS did not begin: is this its port for TLS? Without TLS write tcp://"),
        ("ours expired", "refuses the certificate of this gateway: it has expired: renew it here"),
        ("ours unknown", "refuses the certificate of this gateway: its authority is not known"),
        ("ours missing", "refuses the certificate of this gateway: there is none: write `tls:"),
        ("old version", "speaks no TLS 1.2 or 1.3"),
        ("no file", "No such file or directory"),
        ("half renewed", "no PEM file, or certificate and key do not belong together"),
    ],
)
def test_each_wrong_certificate_has_its_sentence(
    plant: Authority, tmp_path: Path, wrong: str, says: str
) -> None:
    other = Authority(tmp_path)
    certificate, key = of_device(plant, other, wrong)
    tls = of_gateway(plant, other, wrong, certificate)
    context = foreign_server(certificate, key, plant.ca)
    if wrong == "old version":
        with pytest.warns(DeprecationWarning, match="TLSv1_1 is deprecated"):
            context.minimum_version = context.maximum_version = ssl.TLSVersion.TLSv1_1
        context.set_ciphers("ALL:@SECLEVEL=0")
    with serving(None if wrong == "no TLS" else context) as number:
        for loop in LOOPS:
            with asyncio.Runner(loop_factory=loop) as runner:
                assert says in runner.run(refusal(TcpAddress("127.0.0.1", number, tls)))


# Ports of this machine: served lines, doors, device servers


async def calls(number: int, context: ssl.SSLContext, name: str = "127.0.0.1") -> bytes:
    """Connects, sends and returns what comes back; nothing where it is refused."""

    def call() -> bytes:
        try:
            with (
                socket.create_connection(("127.0.0.1", number), PATIENCE) as plain,
                context.wrap_socket(plain, server_hostname=name) as link,
            ):
                link.sendall(b"DTU-1")
                return link.recv(1000)
        except OSError:
            return b""

    return await asyncio.to_thread(call)


class Greeter:
    """The receiver of a connection: answers with the certificate of the other side."""

    def opened(self, port: Port) -> None:
        self.port = port

    def received(self, _data: bytes) -> None:
        assert isinstance(self.port, StreamPort)
        self.port.write(certificate_of(self.port) or b"nobody")

    def lost(self, error: Exception) -> None:
        pass


def client(tls: TlsConfig) -> ssl.SSLContext:
    context = ssl.create_default_context(cafile=tls.ca)
    if tls.certificate is not None and tls.key is not None:
        context.load_cert_chain(tls.certificate, tls.key)
    return context


@pytest.mark.parametrize("loop", LOOPS)
def test_a_port_takes_masters_with_a_certificate_only_and_renewed_files(
    plant: Authority,
    tmp_path: Path,
    loop: Callable[[], asyncio.AbstractEventLoop],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("gateway.transport.tls.READ_AGAIN", 0.0)
    monkeypatch.setattr("gateway.transport.listen._LOG_EVERY", 0.0)
    other = Authority(tmp_path)
    wrong = {
        "shows no certificate": TlsConfig(ca=plant.ca),
        "is not the one of": replace(ours(other, "stranger"), ca=plant.ca),
        "is revoked": ours(plant, "stolen"),
    }
    stolen = wrong["is revoked"].certificate
    assert stolen is not None
    own = replace(ours(plant), revoked=plant.revoke(stolen))

    async def play() -> None:
        number = free_port()
        where = ("127.0.0.1", number)
        listener = Listener(TcpAddress(*where, own))
        await listener.open()
        served = asyncio.create_task(listener.serve(lambda _: Greeter()))
        silent = [await asyncio.to_thread(socket.create_connection, where) for _ in range(40)]
        try:
            await strangers_and_masters(number)
        finally:
            for one in silent:
                one.close()
            served.cancel()
            await listener.close()

    async def strangers_and_masters(number: int) -> None:
        for says, tls in wrong.items():
            assert await calls(number, client(tls)) == b""
            assert says in capsys.readouterr().out
        scada = client(ours(plant, "scada"))
        assert b"scada" in await calls(number, scada)
        certificate = own.certificate
        assert certificate is not None
        certificate.write_text("half")  # a damaged file does not take the place of a good one
        assert b"scada" in await calls(number, scada)
        plant.issue("gateway", names=("renewed.plant",))
        assert b"scada" in await calls(number, scada, "renewed.plant")

    with asyncio.Runner(loop_factory=loop) as runner:
        runner.run(play())


async def test_the_name_in_the_certificate_says_which_device_server_it_is(
    plant: Authority, capsys: pytest.CaptureFixture[str]
) -> None:
    heard, own = RecordingReceiver(), ours(plant)
    server = DeviceServer(b"DTU-1", name="Pump-7.plant")
    where = ListenAddress("127.0.0.1", free_port(), server, own)
    opening = asyncio.create_task(open_port(where, ANY, heard, timeout=PATIENCE))
    await asyncio.sleep(0)
    others = client(ours(plant, "other"))
    while "its certificate has another name" not in capsys.readouterr().out:
        await calls(where.port, others)
    certificate, key = plant.issue("pump", names=("pump-7.plant",))
    right = client(TlsConfig(ca=plant.ca, certificate=certificate, key=key))
    reader, writer = await asyncio.open_connection("127.0.0.1", where.port, ssl=right)
    writer.write(b"DTU-1")
    port = await opening
    port.write(b"request")
    assert await reader.readexactly(7) == b"request"
    writer.write(b"reply")
    await heard.until(lambda r: r.data == b"reply")
    writer.transport.abort()
    close_doors()


def test_own_files_that_are_wrong_are_said_before_anyone_connects(plant: Authority) -> None:
    certificate, _ = plant.issue("gateway")
    with pytest.raises(LineDown, match=r"gateway\.pem: No such file"):
        make_context(
            TlsConfig(certificate=certificate, key=plant.folder / "nowhere.key"), serves=True
        )


class Told(Greeter):
    """Tells how its connection ended."""

    def __init__(self) -> None:
        self.ended = asyncio.get_running_loop().create_future()

    def lost(self, error: Exception) -> None:
        self.ended.set_result(str(error))


@pytest.mark.parametrize("loop", LOOPS)
@pytest.mark.parametrize("side", ["served", "dialled"])
@pytest.mark.parametrize("why", ["has expired", "is revoked"])
def test_an_open_connection_ends_with_the_certificate_of_the_other_side(
    plant: Authority,
    loop: Callable[[], asyncio.AbstractEventLoop],
    monkeypatch: pytest.MonkeyPatch,
    side: str,
    why: str,
) -> None:
    monkeypatch.setattr("gateway.transport.tls.READ_AGAIN", 0.05)
    own, stolen = ours(plant), plant.issue("stolen")
    own = replace(own, revoked=plant.revoke(plant.issue("other")[0]))

    def is_wrong() -> None:
        if why == "is revoked":
            plant.revoke(plant.issue("other")[0], stolen[0])
        else:
            monkeypatch.setattr("gateway.transport.tls._wall", lambda: 4e9)  # in the year 2096

    async def is_served() -> str:
        number, told = free_port(), Told()
        listener = Listener(TcpAddress("127.0.0.1", number, own))
        await listener.open()
        served = asyncio.create_task(listener.serve(lambda _: told))
        shown = client(TlsConfig(ca=plant.ca, certificate=stolen[0], key=stolen[1]))
        reader, writer = await asyncio.open_connection("127.0.0.1", number, ssl=shown)
        writer.write(b"?")
        assert b"stolen" in await reader.read(1000)
        is_wrong()
        said: str = await told.ended
        writer.transport.abort()
        served.cancel()
        await listener.close()
        return said

    async def is_dialled() -> str:
        heard = RecordingReceiver()
        with serving(foreign_server(*stolen)) as number:
            port = await open_port(TcpAddress("127.0.0.1", number, own), ANY, heard)
            is_wrong()
            await heard.until(lambda r: bool(r.losses))
            await port.close()
        return str(heard.losses[0])

    with asyncio.Runner(loop_factory=loop) as runner:
        assert f"its certificate {why}" in runner.run(
            is_served() if side == "served" else is_dialled()
        )


def test_numbers_of_revoked_certificates_are_those_of_the_list(plant: Authority) -> None:
    shown = [plant.issue(name)[0] for name in ("one", "two")]
    numbers = {load_pem_x509_certificate(one.read_bytes()).serial_number for one in shown}
    assert revoked_numbers(plant.revoke(*shown).read_text()) == numbers
    assert revoked_numbers(plant.revoke().read_text()) == set()
    begin, _, end = plant.revoke(*shown).read_text().strip().partition("\n")
    assert revoked_numbers(f"{begin}\n{end[:90]}\n-----END X509 CRL-----") == set()
    assert revoked_numbers("no list") == revoked_numbers(plant.ca.read_text()) == set()
