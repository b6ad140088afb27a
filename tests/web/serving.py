"""The HTTP side over a plant of plain data, without Zenoh, and a client of it."""

import asyncio
import json
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Mapping
from contextlib import asynccontextmanager
from typing import Any, NamedTuple

from gateway.contract.documents.state import DeviceDocument, Expected, StatusDocument, ZenohDocument
from gateway.contract.faults import Documents
from gateway.contract.interfaces import History
from gateway.contract.payload import GroupResult
from gateway.contract.problems import Failure, Problem
from gateway.northbound.requests.audit import Counts
from gateway.parts.web.server import Server
from gateway.parts.web.settings import WebSection
from gateway.plant.part import Core
from gateway.tags import Tag, WriteResult
from gateway.values import Value
from tests.e2e.processes import free_port
from tests.northbound.plant import PlainPlant, mixer

TOKEN = "0123456789-0123456789"  # noqa: S105  (of these tests only)
ZENOH = {
    **dict.fromkeys(ZenohDocument.__annotations__, 0),
    "superseded_most": {},
    "to": ["client"],
    "connect": [],
    "published": 7,
}


DOCUMENTS: Mapping[str, Mapping[str, Any]] = {
    "lines/hall": {
        "open": True,
        "trouble": "",
        "last_trouble": "",
        "opened": 1,
        "open_for": 5.0,
        "open_time": 5.0,
        "baudrate": 19200,
        "busy_time": 1.0,
        "unasked_bytes": 0,
        "devices": {"mixer": "up", "oven": "silent"},
        "expected": {**dict.fromkeys(Expected.__annotations__, 0.0), "load": 0.3},
        "measured": {"load": 0.2, "requests_per_second": 5.0, "slowest_write": 0.0},
        "calls": None,
    },
    **{
        f"devices/{name}": {
            **dict.fromkeys(DeviceDocument.__required_keys__, 1),
            "protocol": "vigor",
            "standing": standing,
            "identity": None,
            "diagnosis": diagnosis,
            "failures": {"silence": 2},
            "refusals": {},
            "refused_addresses": [],
            "requests": [],
        }
        for name, standing, diagnosis in (
            ("mixer", "up", ""),
            ("oven", "silent", "No byte came back: check power, wiring and station number"),
        )
    },
}


def transfer(state: str, **fields: Any) -> Mapping[str, Any]:
    """The document of a transfer from mixer/speed to oven/setpoint."""
    counts = dict.fromkeys(("carried", "not_done", "refused", "unclear"), 0)
    values = {"value": None, "time": None, "last_carried": None, "age": None}
    words = {"when": "on change", "code": None, "meaning": "", "why": ""}
    ends = {"from": "mixer/speed", "to": "oven/setpoint"}
    return {**ends, **words, "state": state, **values, **counts, **fields}


def calling(**fields: Any) -> Mapping[str, Any]:
    """The document of a line with a modem: its last call failed."""
    calls = {
        "state": "idle",
        "since": 4.0,
        "next": 840.0,
        "connected": False,
        "made": 7,
        "failed": 2,
        "in_a_row": 1,
        "last_result": "BUSY",
        "last_failure": "modem:/dev/ttyS0: BUSY",
        "results": {"complete": 7, "BUSY": 2},
    }
    return {**DOCUMENTS["lines/hall"], "devices": {}, "calls": {**calls, **fields}}


class PlainNorth:
    """Documents from a dict, and writes that end as `endings` says for their payload."""

    def __init__(self) -> None:
        self.is_ready = True
        self.changed: dict[str, Mapping[str, Any]] = {}
        self.endings: dict[bytes, WriteResult | Failure | GroupResult] = {}
        self.written: list[tuple[str, bytes, str]] = []
        self.began = asyncio.Event()
        self.fleet: Callable[[], Iterable[tuple[str, bytes, float]]] = list
        self.asked = 0  # for reports
        self.gate = asyncio.Event()  # writes wait for it
        self.gate.set()
        self.orders: Callable[[str, bytes, str | None], Awaitable[bytes]] | None = None

    async def documents(self, max_age: float) -> Documents:
        status: StatusDocument = {
            "contract": 1,
            "name": "demo",
            "version": "1",
            "time": "2026-11-20T12:00:00.000000Z",
            "up": 5.0,
            "tags": 4,
            "simulated": [],
            "replayed": [],
            "lines": {},
            "devices": {},
            "refused_devices": {},
            "refused_claims": [],
            "answered_elsewhere": None,
        }
        return {
            "status": status,
            "zenoh": ZENOH,
            "alarms": {"normal": 3, "active": 1, "acknowledged": 0, "returned": 0},
            "outcomes": Counts().document(),
            **DOCUMENTS,
            **self.changed,
        }

    async def write(
        self, tag: str, data: bytes, by: str, arrived: float
    ) -> WriteResult | Failure | GroupResult:
        self.began.set()
        await self.gate.wait()
        self.written.append((tag, data, by))
        return self.endings.get(data, Failure(Problem.UNKNOWN_TAG, "no such tag"))

    def reports(self) -> Iterable[tuple[str, bytes, float]]:
        self.asked += 1
        return self.fleet()

    def publish_latest(self, path: str, make: Callable[[], bytes]) -> None:
        raise AssertionError("the web publishes nothing")

    async def write_own(
        self, tag: Tag, value: Value, by: str, within: float, *, repeated: bool = True
    ) -> WriteResult:
        raise AssertionError("the web writes for its clients only")

    def deny_own(self, tag: Tag, value: Value | None, by: str, why: str) -> None:
        raise AssertionError("the web writes for its clients only")

    async def order(
        self, part: str, path: str, data: bytes, by: str, arrived: float
    ) -> bytes | Failure:
        self.written.append((path, data, by))
        if self.orders is not None:
            return await self.orders(path, data, by)
        ending = self.endings.get(data, Failure(Problem.NOTHING_TO_ACKNOWLEDGE, "it is normal"))
        return ending if isinstance(ending, Failure) else b"{}"


class Answer(NamedTuple):
    status: int
    headers: Mapping[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)


class Client:
    """Sends requests as they are given; `host` is what a browser would name."""

    def __init__(self, port: int, north: PlainNorth, plant: PlainPlant) -> None:
        self.port = port
        self.north = north
        self.plant = plant

    async def ask(
        self, path: str, method: str = "GET", body: bytes = b"", **headers: str
    ) -> Answer:
        """Underscores of the names of headers stand for hyphens."""
        fields = {"Host": f"127.0.0.1:{self.port}", "Connection": "close"}
        fields |= {name.replace("_", "-"): value for name, value in headers.items()}
        if body:
            fields["Content-Length"] = str(len(body))
        lines = [f"{method} {path} HTTP/1.1", *(f"{k}: {v}" for k, v in fields.items()), "", ""]
        reader, writer = await asyncio.open_connection("127.0.0.1", self.port)
        try:
            writer.write("\r\n".join(lines).encode() + body)
            whole = await asyncio.wait_for(reader.read(), 300)
        finally:
            writer.close()
            await writer.wait_closed()
        head, _, rest = whole.partition(b"\r\n\r\n")
        first, *others = head.decode().split("\r\n")
        found = dict(line.split(": ", 1) for line in others)
        return Answer(int(first.split()[1]), found, rest)


def local(host: str = "127.0.0.1", port: int | None = None, **settings: Any) -> WebSection:
    return WebSection.model_construct(listen=(host, port or free_port()), **settings)


def core_of(plant: PlainPlant, north: PlainNorth, history: History | None = None) -> Core:
    plant.parts.kept = history
    double: Any = plant
    return Core(double, north, plant.parts.history, plant.parts)


@asynccontextmanager
async def serving(**settings: Any) -> AsyncIterator[Client]:
    """Serves at a free port; `settings`: those of `WebSection`, `port`, `history`, `plant`."""
    history, plant = settings.pop("history", None), settings.pop("plant", None) or mixer()
    config, north = local(**settings), PlainNorth()
    server = Server(config, core_of(plant, north, history))
    serves = asyncio.create_task(server.run())
    binds = asyncio.create_task(_until_bound(config.port))
    try:
        await asyncio.wait([serves, binds], return_when=asyncio.FIRST_COMPLETED)
        yield Client(config.port, north, plant)
    finally:
        for task in (serves, binds):
            task.cancel()
        await asyncio.gather(serves, binds, return_exceptions=True)


async def _until_bound(port: int) -> None:
    while True:
        try:
            _, writer = await asyncio.open_connection("127.0.0.1", port)
        except OSError:
            await asyncio.sleep(0.01)  # the server binds without a notice
            continue
        writer.close()
        await writer.wait_closed()
        return
