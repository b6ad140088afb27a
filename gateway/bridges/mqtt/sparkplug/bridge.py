"""Sparkplug B: the gateways as an edge node of a broker.

A device is born when it answers, and dies when it does not, or when its gateway or the way to it
has gone. A metric that is not good is null or has the quality 0, with its reason. An event is sent
when it happens, and never at a birth. Nothing is stored: what changed while the broker was away is
in the next birth.

Commands are taken with `--writes`. A command has no outcome in Sparkplug: the value that the device
has then follows as data. A command that MQTT could deliver twice or late is refused.
"""

import asyncio
import json
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import aiomqtt
from google.protobuf.message import DecodeError

from gateway.bridges.documents import Known
from gateway.bridges.mqtt.broker import checked, client, sessions
from gateway.bridges.mqtt.sparkplug.messages import Payload
from gateway.bridges.mqtt.sparkplug.metrics import value_of
from gateway.bridges.mqtt.sparkplug.node import REBIRTH, EdgeNode
from gateway.bridges.program import Gateways, opened, say
from gateway.bridges.remote_plant import RemotePlant
from gateway.errors import BadValue, ConfigError

LOOK_EVERY = 1.0  # seconds without news
GATHER = 0.05  # seconds: the changes of one message
REBIRTH_PAUSE = 1.0  # seconds between two births that hosts ask for
MOST_COMMANDS = 100  # metrics that wait; the next one is refused
MOST_EVENTS = 10_000  # that wait; then the oldest are lost
LATEST = 5.0  # seconds: a command that waited longer is not sent


class Host:
    """The primary host, by its STATE messages in one session. Without a name it is always there."""

    def __init__(self, name: str | None) -> None:
        self.name = name
        self.is_online = name is None
        self._since = -1

    @property
    def topic(self) -> str:
        return f"spBv1.0/STATE/{self.name}"

    def forget(self) -> None:
        """A session begins: another broker, or a host whose clock was set."""
        self.is_online, self._since = self.name is None, -1

    def take(self, payload: bytes) -> None:
        """Takes a state that is no older than the last one."""
        with suppress(ValueError, AttributeError):
            state = json.loads(payload)
            online, at = state.get("online"), state.get("timestamp")
            if type(online) is bool and type(at) is int and at >= self._since:
                self.is_online, self._since = online, at


class SparkplugBridge:
    """Serves the node in sessions with a broker."""

    def __init__(self, host: str | None, writes: bool) -> None:
        self.node: EdgeNode
        self.plant: RemotePlant
        self._host, self._writes = Host(host), writes
        self._pending: dict[str, None] = {}  # keys with a new value
        self._events: deque[tuple[str, Known]] = deque(maxlen=MOST_EVENTS)
        self._new: set[str] = set()  # devices with a new description
        self._rebirth, self._born_at = False, 0.0
        self._news = asyncio.Event()
        self._open: set[asyncio.Task[None]] = set()

    def described(self, key: str, _meta: Known) -> None:
        self.node.describe(key)
        self._new.add(key.partition("/")[0])
        self._news.set()

    def changed(self, key: str, known: Known) -> None:
        if self.plant.tags[key].get("event"):
            self._events.append((key, known))
        else:
            self._pending[key] = None
        self._news.set()

    def client(self, address: str) -> aiomqtt.Client:
        topic, death = self.node.connecting()
        will = aiomqtt.Will(topic, death, qos=1, retain=False)
        identifier = "-".join(["gateway", *self.node.topic("").split("/")[1::2]])
        return client(address, identifier, will, aiomqtt.ProtocolVersion.V311)

    async def session(self, broker: aiomqtt.Client) -> None:
        """Ends when the primary host has gone."""
        self._host.forget()
        is_born = False
        try:
            if self._host.name:
                await broker.subscribe(self._host.topic, qos=1)
            await broker.subscribe(self.node.topic("NCMD"), qos=1)
            if self._writes:
                await broker.subscribe(self.node.topic("DCMD", "+"), qos=1)
            say("connected to the broker")
            async with asyncio.TaskGroup() as group:
                receiving = group.create_task(self._receive(broker))
                while self._host.is_online or not is_born:
                    if self._host.is_online:
                        await self._publish(broker, is_birth=not is_born)
                        is_born = True
                    with suppress(TimeoutError):
                        async with asyncio.timeout(LOOK_EVERY):
                            await self._news.wait()
                        await asyncio.sleep(GATHER)
                    self._news.clear()
                say(f"the host {self._host.name} is offline")
                receiving.cancel()
        finally:
            with suppress(aiomqtt.MqttError):  # then the broker publishes the last will
                if is_born:
                    await broker.publish(*self.node.death(), qos=1)

    async def _publish(self, broker: aiomqtt.Client, *, is_birth: bool) -> None:
        """Publishes births and deaths, then every change."""
        if self._rebirth:
            await asyncio.sleep(self._born_at + REBIRTH_PAUSE - time.monotonic())
        if is_birth or self._rebirth:
            self._rebirth, self._born_at = False, time.monotonic()
            self._pending.clear()
            await broker.publish(*self.node.birth())
        there = self.plant.trusted
        for device in sorted(self.node.born - there):
            await broker.publish(*self.node.device_death(device))
        born = self.node.born - self._new
        self._new.clear()
        for device in sorted(there - born):
            await broker.publish(*self.node.device_birth(device))
        while (self._pending or self._events) and not self._rebirth:
            events, self._events = self._events, deque(maxlen=MOST_EVENTS)
            pending, self._pending = self._pending, {}
            changes = [(key, self.plant.values[key]) for key in pending]
            for message in self.node.data([*events, *changes]):
                await broker.publish(*message)

    async def _receive(self, broker: aiomqtt.Client) -> None:
        async for message in broker.messages:
            topic, arrived = str(message.topic), time.monotonic()
            if topic == self._host.topic:
                self._host.take(bytes(message.payload))
                self._news.set()
                continue
            payload = Payload()
            try:
                payload.ParseFromString(bytes(message.payload))
            except DecodeError:
                say(f"{topic}: no payload of Sparkplug B")
                continue
            if topic != self.node.topic("NCMD"):
                self._commands(topic, payload, message, arrived)
            elif any(one.name == REBIRTH and one.boolean_value for one in payload.metrics):
                self._rebirth = True
                self._news.set()

    def _commands(self, topic: str, payload: Any, message: aiomqtt.Message, arrived: float) -> None:
        if message.retain or message.qos:
            say(f"{topic}: MQTT may deliver it again: publish it with QoS 0, not retained")
            return
        device = topic.rpartition("/")[2]
        for metric in payload.metrics:
            key = self.node.key(device, metric)
            if key is None or len(self._open) >= MOST_COMMANDS:
                why = "there is no such metric" if key is None else "too many commands wait"
                say(f"{topic}: {metric.name or metric.alias}: {why}")
                continue
            task = asyncio.create_task(self._write(key, metric, arrived))
            self._open.add(task)
            task.add_done_callback(self._open.discard)

    async def _write(self, key: str, metric: Any, arrived: float) -> None:
        try:
            value = value_of(metric, self.plant.tags[key])
        except BadValue as error:
            say(f"{key}: bad-value: {error}")
            return
        outcome = {"outcome": "busy"}
        if time.monotonic() - arrived <= LATEST:
            outcome = await self.plant.write(key, value)
        say(f"{key} = {value}: {outcome['outcome']} {outcome.get('reason', '')}")


async def bridge(
    gateways: Gateways, brokers: Sequence[str], ids: tuple[str, str], host: str | None, writes: bool
) -> None:
    """Serves until it is cancelled. `ids`: of group and node; `host`: the primary host."""
    checked(brokers)
    for one in (*ids, host):
        if one is not None and (not one or any(letter in one for letter in "+/#\0")):
            raise ConfigError(f"{one!r} is no id of Sparkplug: it is a text without + / #")
    with await opened(gateways) as session:
        served = SparkplugBridge(host, writes)
        plant = RemotePlant(session, gateways.prefix, served.described, served.changed)
        served.plant, served.node = plant, EdgeNode(*ids, plant)
        async with asyncio.TaskGroup() as group:
            group.create_task(plant.follow())
            group.create_task(sessions(brokers, served.client, served.session))
