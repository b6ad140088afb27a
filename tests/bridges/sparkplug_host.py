"""A host of Sparkplug B, written from the specification 3.0 alone: it checks each message.

It shares nothing with the bridge: the payload is decoded here, by the wire format of protobuf.
"""

import json
import struct
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, Self

from paho.mqtt.client import Client, MQTTMessage
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion
from paho.mqtt.subscribeoptions import SubscribeOptions

_VALUES = {3: "int", 4: "long", 5: "float", 6: "double", 7: "boolean", 8: "string"}
_PROPERTY = {1: "type", 2: "is_null", **_VALUES}
_SET = {1: "*keys", 2: "*values"}
_METRIC = {1: "name", 2: "alias", 3: "timestamp", 4: "datatype", 7: "is_null", 9: "properties"}
_METRIC |= {number + 7: name for number, name in _VALUES.items()} | {16: "bytes"}
_PAYLOAD = {1: "timestamp", 2: "*metrics", 3: "seq"}
_INNER: dict[str, dict[int, str]] = {"*metrics": _METRIC, "properties": _SET, "*values": _PROPERTY}
_TEXTS = ("name", "*keys", "string")
Known = dict[str, Any]


def decoded(data: bytes, fields: dict[int, str] = _PAYLOAD) -> Known:
    """Returns the fields of a message by their names. Raises KeyError for one that is unknown."""
    found: Known = {name[1:]: [] for name in fields.values() if name[0] == "*"}
    for number, value in _fields(data):
        name = fields[number]
        if name in _INNER:
            value = decoded(value, _INNER[name])
        elif name in _TEXTS:
            value = value.decode()
        elif name in ("float", "double"):
            [value] = struct.unpack("<f" if name == "float" else "<d", value)
        if name[0] == "*":
            found[name[1:]].append(value)
        else:
            found[name] = value
    return found


def _fields(data: bytes) -> Iterator[tuple[int, Any]]:
    at = 0

    def varint() -> int:
        nonlocal at
        value = shift = 0
        while True:
            octet, at = data[at], at + 1
            value |= (octet & 0x7F) << shift
            shift += 7
            if octet < 0x80:
                return value

    while at < len(data):
        tag = varint()
        if tag & 7 == 0:
            yield tag >> 3, varint()
            continue
        length = {1: 8, 2: 0, 5: 4}[tag & 7] or varint()
        yield tag >> 3, data[at : at + length]
        at += length


def command(name: str, **value: float | bytes) -> bytes:
    """Returns the payload of a command: `boolean=True`, `long=7`, `alias=…`, `datatype=…`."""

    def field(number: int, content: float | bytes) -> bytes:
        if isinstance(content, float):
            return _varint(number << 3 | 1) + struct.pack("<d", content)
        if isinstance(content, int):
            return _varint(number << 3) + _varint(content)
        return _varint(number << 3 | 2) + _varint(len(content)) + content

    numbers = {known: number for number, known in _METRIC.items()}
    metric = field(1, name.encode()) if name else b""
    for known, content in value.items():
        metric += field(numbers[known], content)
    return field(1, int(time.time() * 1000)) + field(2, metric)


def _varint(value: int) -> bytes:
    found = bytearray()
    while value > 0x7F:
        found.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*found, value])


class Message(NamedTuple):
    topic: str
    qos: int
    retain: bool
    payload: Known

    @property
    def kind(self) -> str:
        return self.topic.split("/")[2]

    @property
    def device(self) -> str:
        return "/".join(self.topic.split("/")[4:])

    @property
    def is_data(self) -> bool:
        return self.kind in ("NDATA", "DDATA")

    @property
    def is_birth(self) -> bool:
        return self.kind in ("NBIRTH", "DBIRTH")

    def metric(self, name: str) -> Known:
        return next((one for one in self.payload["metrics"] if one.get("name") == name), {})


class SparkplugHost:
    """Follows one edge node. `values`: by `device/metric`, None while it is stale or not good."""

    def __init__(self, port: int, group: str, node: str, name: str = "scada") -> None:
        self.messages: list[Message] = []
        self.wrong: list[tuple[str, str]] = []  # rule, topic
        self.checked: set[str] = set()
        self.values: dict[str, Any] = {}
        self.is_online = self._knows = False
        self.seq = self.bd_seq = self.last_bd_seq = -1
        self.aliases: dict[int, tuple[str, Known]] = {}  # key, metric of its birth
        self._ids, self._state = (group, node), f"spBv1.0/STATE/{name}"
        self._news = threading.Condition()
        self._client = Client(
            CallbackAPIVersion.VERSION2, f"host-{name}", protocol=MQTTProtocolVersion.MQTTv5
        )
        self._client.reconnect_delay_set(1, 1)
        self._client.on_message = self._arrived
        self._client.on_connect = lambda *_: self._subscribe()
        # Births that it has missed: a host asks for them.
        self._client.on_subscribe = lambda *_: self.send(
            command("Node Control/Rebirth", boolean=True), wait=False
        )
        self._client.on_disconnect = lambda *_: self._lost()
        self._client.connect_async("127.0.0.1", port, 10)

    def __enter__(self) -> Self:
        self._client.loop_start()
        return self

    def __exit__(self, *_error: object) -> None:
        self._client.disconnect()
        self._client.loop_stop()

    def say(self, *, online: bool, at: int) -> None:
        text = json.dumps({"online": online, "timestamp": at})
        self._client.publish(self._state, text, 1, retain=True).wait_for_publish(300)

    def send(self, payload: bytes, *device: str, qos: int = 0, wait: bool = True) -> None:
        group, node = self._ids
        topic = "/".join(["spBv1.0", group, "DCMD" if device else "NCMD", node, *device])
        sent = self._client.publish(topic, payload, qos)
        if wait:
            sent.wait_for_publish(300)

    def until(self, check: Callable[[], bool], what: str, within: float = 12) -> None:
        with self._news:
            assert self._news.wait_for(check, within), (what, self.kinds()[-20:], self.values)

    def kinds(self) -> list[str]:
        return [message.kind for message in self.messages]

    def alive(self) -> set[str]:
        """Returns the devices that were born since the node was, and did not die."""
        found = set[str]()
        for message in self.messages:
            if message.kind in ("NBIRTH", "NDEATH"):
                found.clear()
            elif message.kind == "DBIRTH":
                found.add(message.device)
            elif message.kind == "DDEATH":
                found.discard(message.device)
        return found

    def _subscribe(self) -> None:
        group, node = self._ids
        options = SubscribeOptions(qos=1, retainAsPublished=True)
        topics = [f"spBv1.0/{group}/+/{node}", f"spBv1.0/{group}/+/{node}/+"]
        self._client.subscribe([(topic, options) for topic in topics])

    def _lost(self) -> None:
        """Without the broker all is stale."""
        with self._news:
            self.is_online = self._knows = False
            self.values = dict.fromkeys(self.values)
            self._news.notify_all()

    def _arrived(self, _client: object, _data: object, raw: MQTTMessage) -> None:
        if raw.topic.split("/")[2] in ("NCMD", "DCMD"):
            return
        self._knows |= raw.topic.split("/")[2] == "NBIRTH"
        if not self._knows:
            return
        message = Message(raw.topic, raw.qos, raw.retain, decoded(bytes(raw.payload)))
        with self._news:
            for rule, check in CHECKS.items():
                verdict = check(self, message)
                if verdict is not None:
                    self.checked.add(rule)
                if verdict is False:
                    self.wrong.append((rule, message.topic))
            self.messages.append(message)
            self._take(message)
            self._news.notify_all()

    def _take(self, message: Message) -> None:
        metrics = message.payload["metrics"]
        if message.kind == "NDEATH":
            if message.metric("bdSeq")["long"] == self.bd_seq:
                self.is_online, self.values = False, dict.fromkeys(self.values)
            return
        self.seq = message.payload["seq"]
        match message.kind:
            case "NBIRTH":
                self.last_bd_seq, self.bd_seq = self.bd_seq, message.metric("bdSeq")["long"]
                self.is_online, self.values = True, dict.fromkeys(self.values)
                self.aliases = {}
            case "DDEATH":
                of_device = [key for key in self.values if key.startswith(f"{message.device}/")]
                self.values |= dict.fromkeys(of_device)
            case "DBIRTH":
                for one in metrics:
                    self.aliases[one["alias"]] = (f"{message.device}/{one['name']}", one)
        if message.kind in ("DBIRTH", "DDATA"):
            for one in metrics:
                key, born = self.aliases[one["alias"]]
                self.values[key] = good_value(one, born["datatype"])


def quality(metric: Known) -> int:
    about = dict(zip(*metric["properties"].values(), strict=True))
    return int(about["Quality"]["int"])


def good_value(metric: Known, datatype: int) -> Any:
    """Returns None for a value that is not good."""
    if quality(metric) != 192 or metric.get("is_null"):
        return None
    if "int" in metric and datatype <= 3:
        return metric["int"] - (metric["int"] >> 31 << 32)
    return next(metric[name] for name in (*_VALUES.values(), "bytes") if name in metric)


# ---- the rules: None where a rule does not concern a message -----------------------------------

Check = Callable[[SparkplugHost, Message], bool | None]


def _of(*kinds: str) -> Callable[[Callable[[SparkplugHost, Message], bool]], Check]:
    def made(check: Callable[[SparkplugHost, Message], bool]) -> Check:
        return lambda host, message: check(host, message) if message.kind in kinds else None

    return made


_NODE, _DEVICE = ("NBIRTH", "NDATA", "NDEATH"), ("DBIRTH", "DDATA", "DDEATH")
_NUMBERED = ("NBIRTH", "NDATA", *_DEVICE)
_ORDERED = tuple(kind for kind in _NUMBERED if kind != "NBIRTH")
_BIRTHS = ("NBIRTH", "DBIRTH")


def _has_value(metric: Known) -> bool:
    fields = [name for name in (*_VALUES.values(), "bytes") if name in metric]
    return len(fields) == int(not metric.get("is_null"))


def _of_now(message: Message) -> bool:
    return bool(abs(message.payload["timestamp"] / 1000 - time.time()) < 600)


def _properties(message: Message) -> list[Known]:
    return [one["properties"] for one in message.payload["metrics"] if "properties" in one]


CHECKS: dict[str, Check] = {
    "the topic has its form": _of(*_NODE, *_DEVICE)(
        lambda _, m: m.topic.startswith("spBv1.0/") and bool(m.device) == (m.kind[0] == "D")
    ),
    "its payload is of protobuf, and has a time": _of(*_NUMBERED)(lambda _, m: _of_now(m)),
    "QoS 0, not retained": _of(*_NUMBERED)(lambda _, m: (m.qos, m.retain) == (0, False)),
    "the death has QoS 1, not retained": _of("NDEATH")(
        lambda _, m: (m.qos, m.retain) == (1, False)
    ),
    "the birth has the number 0": _of("NBIRTH")(lambda _, m: m.payload["seq"] == 0),
    "each number follows the last": _of(*_ORDERED)(
        lambda host, m: m.payload["seq"] == (host.seq + 1) % 256
    ),
    "the death has bdSeq and nothing else": _of("NDEATH")(
        lambda _, m: "seq" not in m.payload and len(m.payload["metrics"]) == 1
    ),
    "the death has the bdSeq of the birth": _of("NDEATH")(
        lambda host, m: m.metric("bdSeq")["long"] == host.bd_seq
    ),
    "bdSeq is an Int64, in 0 to 255": _of("NBIRTH", "NDEATH")(
        lambda _, m: m.metric("bdSeq")["datatype"] == 4 and m.metric("bdSeq")["long"] < 256
    ),
    "the node control is a Boolean without alias": _of("NBIRTH")(
        lambda _, m: (
            m.metric("Node Control/Rebirth").items() >= {"datatype": 11, "boolean": 0}.items()
            and "alias" not in m.metric("Node Control/Rebirth")
        )
    ),
    "a birth has name, type, time and value of each metric": _of(*_BIRTHS)(
        lambda _, m: all(
            {"name", "datatype", "timestamp"} <= one.keys() and _has_value(one)
            for one in m.payload["metrics"]
        )
    ),
    "a device's birth has aliases, unique in the node": _of("DBIRTH")(
        lambda host, m: all(
            host.aliases.get(one["alias"], (f"{m.device}/{one['name']}",))[0]
            == f"{m.device}/{one['name']}"
            for one in m.payload["metrics"]
        )
    ),
    "data has the alias of a birth, and no name or type": _of("NDATA", "DDATA")(
        lambda host, m: all(
            one.get("alias") in host.aliases and not {"name", "datatype"} & one.keys()
            for one in m.payload["metrics"]
        )
    ),
    "data has time and value of each metric": _of("NDATA", "DDATA")(
        lambda _, m: all("timestamp" in one and _has_value(one) for one in m.payload["metrics"])
    ),
    "a type is one of the list": _of(*_BIRTHS)(
        lambda _, m: all(1 <= one["datatype"] <= 34 for one in m.payload["metrics"])
    ),
    "metrics are in the order of time": _of("DBIRTH", "DDATA")(
        lambda _, m: (times := [one["timestamp"] for one in m.payload["metrics"]]) == sorted(times)
    ),
    "properties have as many keys as values, with types": _of("DBIRTH", "DDATA")(
        lambda _, m: all(
            len(one["keys"]) == len(one["values"]) and all("type" in each for each in one["values"])
            for one in _properties(m)
        )
    ),
    "the quality is an Int32 of the list": _of("DBIRTH", "DDATA")(
        lambda _, m: all(
            one["values"][one["keys"].index("Quality")] in ({"type": 3, "int": q} for q in (0, 192))
            for one in _properties(m)
        )
    ),
    "a node is born before its devices, and these before data": _of(*_DEVICE)(
        lambda host, m: (
            host.is_online
            and (
                m.kind == "DBIRTH"
                or any(key.startswith(f"{m.device}/") for key, _ in host.aliases.values())
            )
        )
    ),
    "data has only what changed": _of("DDATA")(lambda _, m: len(m.payload["metrics"]) > 0),
}
