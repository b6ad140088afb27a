"""The clients of the bridges in `make bridges`: each shows what it holds for good."""

import asyncio
import json
import threading
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any, Self

from asyncua import Client as UaClient
from asyncua import Node, ua
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
from paho.mqtt.client import Client, MQTTMessage
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion

from tests.bridges.opcua_clients import TOKENS, URI

DEVICES = ("a", "b", "c")
TAGS: dict[str, dict[str, Any]] = {
    f"{device}/{tag}": {"type": "int32"} for device in DEVICES for tag in ("one", "two", "three")
}


class JsonClient:
    """Shows a value while it is good, and the bridge `online`."""

    def __init__(self, port: int) -> None:
        self._values: dict[str, int | None] = dict.fromkeys(TAGS)
        self._online = False
        self._client = Client(
            CallbackAPIVersion.VERSION2, "reader", protocol=MQTTProtocolVersion.MQTTv5
        )
        self._client.reconnect_delay_set(1, 1)
        self._client.on_connect = lambda *_: self._subscribe()
        self._client.on_disconnect = lambda *_: self._forget()
        self._client.on_message = self._arrived
        self._client.connect_async("127.0.0.1", port, 10)

    def __enter__(self) -> Self:
        self._client.loop_start()
        return self

    def __exit__(self, *_error: object) -> None:
        self._client.disconnect()
        self._client.loop_stop()

    def shown(self) -> dict[str, object]:
        return dict(self._values) if self._online else {}

    def _subscribe(self) -> None:
        self._client.subscribe("plant/#", 1)

    def _forget(self) -> None:
        self._online, self._values = False, dict.fromkeys(TAGS)

    def _arrived(self, _client: object, _data: object, message: MQTTMessage) -> None:
        key = message.topic.removeprefix("plant/")
        if key == "@bridge":
            self._online = message.payload == b"online"
        elif key in TAGS:
            known = json.loads(message.payload)
            self._values[key] = known["value"] if known["quality"] == "good" else None


class InfluxServer:
    """Keeps the last line of each tag; answers 503 while it is `ill`."""

    def __init__(self) -> None:
        self.ill = False
        self._values: dict[str, tuple[int, int | None]] = {}
        self.good: list[tuple[str, int]] = []
        server = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"])).decode()
                self.send_response(503 if server.ill else 204)
                self.end_headers()
                if not server.ill:
                    server.take(body)

            def log_message(self, *_: object) -> None:
                pass

        self._handler = Handler
        self._open(0)
        self.url = f"http://127.0.0.1:{self._http.server_port}/write"

    def _open(self, port: int) -> None:
        self._http = HTTPServer(("127.0.0.1", port), self._handler)
        self._thread = threading.Thread(target=self._http.serve_forever)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self.kill()

    def kill(self) -> None:
        """Closes its port."""
        if self._thread.is_alive():
            self._http.shutdown()
            self._thread.join()
            self._http.server_close()

    def start(self) -> None:
        """Listens again, with what it has."""
        self._open(self._http.server_port)
        self._thread.start()

    def take(self, body: str) -> None:
        for line in body.splitlines():
            if not line.startswith("plc,"):
                continue
            about, fields, at = line.split(" ")
            device, name = (part.partition("=")[2] for part in about.split(",")[1:3])
            is_good = "good=true" in fields
            value = int(float(fields.partition("value=")[2].partition(",")[0])) if is_good else None
            key = f"{device}/{name}"
            if value is not None:
                self.good.append((key, value))
            if int(at) >= self._values.get(key, (0, None))[0]:
                self._values[key] = int(at), value

    def shown(self) -> dict[str, object]:
        return {key: value for key, (_, value) in self._values.items()}


class OpcuaClient:
    """Watches all tags and reads them every second: with certificate, user and encryption.

    `watched` and `read` are the values that it shows: of the subscription, of the last read.
    """

    def __init__(self, url: str, folder: Path) -> None:
        self.watched: dict[str, object] = {}
        self.read: dict[str, object] = {}
        self._url, self._folder = url, folder
        self._has_begun = threading.Event()
        self._client: UaClient | None = None
        self._is_over = False
        self._thread = threading.Thread(target=asyncio.run, args=(self._run(),))
        self._thread.start()

    def kill(self) -> None:
        """Ends as a killed program does: the session stays open in the server."""
        if self._thread.is_alive():
            self._has_begun.wait()
            self._loop.call_soon_threadsafe(self._drop)
            self._thread.join()

    def _drop(self) -> None:
        self._is_over = True
        if self._client is not None:
            self._client.disconnect_socket()

    async def _run(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._has_begun.set()
        while not self._is_over:
            with suppress(OSError, TimeoutError, ua.UaError, asyncio.CancelledError):
                await self._watch()
            self.watched, self.read = {}, {}
            await asyncio.sleep(0.5)

    async def _watch(self) -> None:
        client = self._client = UaClient(self._url, timeout=5)
        client.application_uri = URI
        client.set_user("ana")
        client.set_password(TOKENS["ana"])
        trusted = self._folder / "pki" / "trusted" / "scada.der"
        await client.set_security(
            SecurityPolicyBasic256Sha256, trusted, self._folder / "client.pem"
        )
        await client.connect()
        try:
            nodes = [ua.NodeId(key, 2) for key in TAGS]
            subscription = await client.create_subscription(100, self)
            await subscription.subscribe_data_change([client.get_node(node) for node in nodes])
            while not self._is_over:
                found = await client.uaclient.read_attributes(nodes, ua.AttributeIds.Value)
                self.read = dict(zip(TAGS, map(_good, found), strict=True))
                await asyncio.sleep(1)
        finally:
            if not self._is_over:
                await client.disconnect()

    def datachange_notification(self, node: Node, _value: object, data: Any) -> None:
        self.watched[node.nodeid.Identifier] = _good(data.monitored_item.Value)


def _good(value: ua.DataValue) -> object:
    is_good = value.StatusCode is None or value.StatusCode.is_good()
    return value.Value.Value if is_good and value.Value else None
