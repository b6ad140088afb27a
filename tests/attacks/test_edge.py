"""Small attacks from the web, Zenoh and the disk, all at one gateway that runs."""

import asyncio
import json
import socket
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from gateway.parts.history.store.file import HistoryFile
from tests.attacks.test_forged_claim import forged_claims
from tests.e2e.processes import free_port, started, vigor_line, write_config
from tests.northbound.access import secret
from tests.zenoh_peer import ZenohPeer, free_endpoint

TOKEN = "t" * 40
HOST = b"Host: 127.0.0.1\r\n"
POST = b"POST /api/write?tag=mixer/speed HTTP/1.1\r\n" + HOST
BEARER = b"Authorization: Bearer "
REQUESTS = {  # what cannot be understood, each refused with 400
    "no ASCII": b"GET /api/tags HTTP/1.1\r\n" + HOST + BEARER + b"\xff\r\n\r\n",
    "CR in a token": b"GET / HTTP/1.1\r\n" + HOST + BEARER + TOKEN.encode() + b"\rX: 1\r\n\r\n",
    "5,000 digits": b"GET /api/transfers?after=" + b"9" * 5000 + b" HTTP/1.1\r\n" + HOST + b"\r\n",
    "no gzip": POST
    + (BEARER + TOKEN.encode() + b"\r\nContent-Type: application/json\r\n")
    + b"Content-Encoding: gzip\r\nContent-Length: 1\r\n\r\n7",
}
LAST = b'{"ticket": 18446744073709551615, "group": null, "devices": ["mixer"]}'


def status_of(port: int, request: bytes) -> bytes:
    with socket.create_connection(("127.0.0.1", port), timeout=300) as one:
        one.sendall(request)
        return one.recv(4096)[:12]


@contextmanager
def names_taken() -> Iterator[None]:
    """Holds the abstract names that a gateway once took, as any user can."""
    with socket.socket(socket.AF_UNIX) as one, socket.socket(socket.AF_UNIX) as other:
        one.bind("\0plc-gateway-demo")
        other.bind("\0plant/@gateway/demo")
        yield


async def test_what_cannot_be_understood_changes_nothing_and_prints_no_secret(
    tmp_path: Path,
) -> None:
    endpoint, port, path = free_endpoint(), free_port(), tmp_path / "history.db"
    secret(tmp_path / "tokens.txt", f"page:{TOKEN}\n")
    with closing(HistoryFile(path, 10**8)):
        pass
    with closing(sqlite3.connect(path)) as restored:
        restored.execute("CREATE TRIGGER no BEFORE INSERT ON sample BEGIN DELETE FROM tag; END")
    tags = {"speed": {"address": "D10", "write": True, "alarm": {"low": 30_000}, "history": True}}
    file = write_config(
        tmp_path / "plant.yaml",
        endpoint,
        {"hall": vigor_line("simulator", tags)},
        web={"listen": f"127.0.0.1:{port}", "tokens_file": "tokens.txt"},
        alarms={"path": "alarms.json"},
        history={"path": "history.db"},
    )
    with names_taken(), await asyncio.to_thread(started, file) as gateway:
        await asyncio.to_thread(gateway.says, "web page ready")
        for name, request in REQUESTS.items():
            found = await asyncio.to_thread(status_of, port, request)
            assert found[-3:] == b"400", name
        async with ZenohPeer("client", connect=[endpoint]) as client:
            with forged_claims(endpoint, document=LAST):
                await asyncio.to_thread(gateway.says, "claim refused")
                [speed] = await client.get("plant/mixer/speed")
                assert speed.json["quality"] == "good"
                with await asyncio.to_thread(started, other_file(tmp_path, endpoint)) as newcomer:
                    assert not newcomer.has_said("Traceback")
            alarm = "plant/@gateway/demo/alarms/mixer/speed"
            await client.get_until(alarm, lambda one: one["state"] == "active")
            [acknowledged] = await client.get(alarm, b'{"by": "Ana"}')
            assert acknowledged.json["state"] == "acknowledged"
            await client.get_until(
                "plant/@gateway/demo/history", lambda one: one["state"] == "ok" and one["aside"]
            )
        assert (tmp_path / "alarms.json").stat().st_mode & 0o777 == 0o600
        assert json.loads((tmp_path / "alarms.json").read_text())["alarms"]
        assert not gateway.has_said(TOKEN)
        assert not gateway.has_said("Traceback")


def other_file(folder: Path, endpoint: str) -> Path:
    """A gateway that starts while the immense ticket is claimed."""
    press = {"protocol": "vigor", "station": 1, "tags": {"force": {"address": "D1"}}}
    return write_config(
        folder / "other.yaml",
        "",
        {"annex": {"port": "simulator", "devices": {"press": press}}},
        gateway={"name": "other"},
        zenoh={"prefix": "plant", "listen": [], "connect": [endpoint]},
    )
