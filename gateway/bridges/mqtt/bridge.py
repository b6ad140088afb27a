"""MQTT: values of the gateways to a broker, and writes back.

| topic | retained | payload |
|---|---|---|
| `plant/mixer/speed` | yes | `{"value": 12.5, "quality": "good", "time": "…"}`, as on Zenoh |
| `plant/scanner/code` | no | a tag with `event: true`: each event once, if the bridge is there |
| `plant/@meta/mixer/speed` | yes | type, unit, limits |
| `plant/@bridge` | yes | `online`, or `offline` (the last will) |
| `plant/@set/mixer/recipe` | no | a command: `7`, or `{"value": 7, "id": "a1", "time": "…"}` |
| `plant/@outcome/mixer/recipe` | no | `{"id": "a1", "outcome": "written", "value": 7, …}` |

Use a value only while its quality is `good` and `plant/@bridge` is `online`. It is `offline` also
while a change has waited for more than a second. When a gateway or the way to it is gone, all its
values are `bad` (`no-gateway`). When the bridge is gone, the broker publishes the last will, and
forgets the retained values after `--expire` seconds (MQTT 5).

Commands are accepted with `--writes`. Everyone who may publish to `plant/@set/#` may then write, so
restrict this topic in the broker. A command has one outcome: `written` only when the device has
acknowledged, an error of docs/zenoh.md, or `unclear`: it may or may not have been done. No outcome
within twenty seconds means the same. The bridge never repeats a command.

MQTT may deliver a command of QoS 1 or 2 twice. So it needs an `id`, a new one for each command. A
known id is not written again, also after a restart (`--commands`); the bridge publishes its outcome
again. With `time` the gateway refuses a command that is older than five seconds.
"""

import asyncio
import json
import math
import os
import sqlite3
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from weakref import WeakValueDictionary

import aiomqtt
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.subscribeoptions import SubscribeOptions

from gateway.bridges.documents import Known, bad
from gateway.bridges.mqtt.broker import checked, client, sessions
from gateway.bridges.mqtt.commands import Commands, parsed
from gateway.bridges.program import Gateways, opened, say
from gateway.bridges.remote_plant import RemotePlant

BATCH = 100  # messages on their way to the broker
LATE = 1.0  # seconds: longer than that no change waits while the bridge is `online`
MOST_COMMANDS = 100  # that wait; the next one is dropped, without an outcome
MOST_MESSAGES = 10_000  # outcomes and events that wait for the broker; then the oldest are lost
LATEST = 5.0  # seconds: a command that waited longer is not sent


class Bridge:
    def __init__(self, root: str, expire: int, commands: Path | None) -> None:
        self.plant: RemotePlant
        self._root, self._expire = root, expire
        self._commands = Commands(commands) if commands else None
        self._retained: dict[str, bytes] = {}  # by topic
        self._pending: dict[str, float] = {}  # changed topics, in order; since when
        self._repeats: dict[str, float] = {}  # topics to publish again before they expire
        self._is_online = False
        self._messages: deque[tuple[str, bytes]] = deque(maxlen=MOST_MESSAGES)
        self._news = asyncio.Event()
        self._open: set[asyncio.Task[None]] = set()
        self._turns: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()

    def described(self, key: str, meta: Known) -> None:
        self._keep(f"{self._root}/@meta/{key}", meta)

    def changed(self, key: str, known: Known) -> None:
        if self.plant.tags[key].get("event"):
            self._send(f"{self._root}/{key}", known)
        else:
            self._keep(f"{self._root}/{key}", known)

    def _send(self, topic: str, document: Known) -> None:
        """Publishes a message that counts by itself: once, in order, not retained."""
        self._messages.append((topic, json.dumps(document, ensure_ascii=False).encode()))
        self._news.set()

    def _keep(self, topic: str, document: Known) -> None:
        self._retained[topic] = json.dumps(document, ensure_ascii=False).encode()
        self._pending.setdefault(topic, time.monotonic())
        self._news.set()

    def client(self, address: str) -> aiomqtt.Client:
        will = aiomqtt.Will(f"{self._root}/@bridge", "offline", qos=1, retain=True)
        return client(
            address, f"gateway-{self._root.replace('/', '-')}", will, aiomqtt.ProtocolVersion.V5
        )

    async def session(self, broker: aiomqtt.Client) -> None:
        """Publishes everything, then every change; `online` comes after the first values."""
        self._is_online = False
        broker.pending_calls_threshold = 2 * BATCH
        try:
            await self._clear(broker)
            self._pending |= dict.fromkeys(self._retained, time.monotonic())
            if self._commands:
                options = SubscribeOptions(qos=1, retainAsPublished=True, retainHandling=2)
                await broker.subscribe(f"{self._root}/@set/#", options=options)
            await self._publish(broker)
            say("connected to the broker")
            async with asyncio.TaskGroup() as group:
                group.create_task(self._publish_changes(broker))
                if self._commands:
                    group.create_task(self._receive(broker, self._commands))
        finally:
            with suppress(aiomqtt.MqttError):  # then the broker publishes the last will
                await self._tell(broker, False)
                for topic, known in self._retained.items():
                    if b'"quality": "bad"' not in known:
                        await self._retain(broker, topic, json.dumps(bad("no-bridge")).encode())

    async def _tell(self, broker: aiomqtt.Client, online: bool) -> None:
        """Says it for as long as values are kept: a broker may end together with this bridge, and
        begin again with what it had."""
        self._is_online = online
        state = b"online" if online else b"offline"
        await self._retain(broker, f"{self._root}/@bridge", state, qos=1)

    async def _clear(self, broker: aiomqtt.Client) -> None:
        """Replaces what an earlier run left at the broker and this one does not have."""
        everything, mark = f"{self._root}/#", f"{self._root}/@bridge/{os.urandom(8).hex()}"
        await broker.subscribe(everything)
        await broker.publish(mark)  # arrives after all that is retained
        async for message in broker.messages:
            topic = str(message.topic)
            if topic == mark:
                break
            if message.retain and topic not in self._retained and topic != f"{self._root}/@bridge":
                empty = b"" if "/@" in topic else json.dumps(bad("no-gateway")).encode()
                await self._retain(broker, topic, empty)
        await broker.unsubscribe(everything)
        while len(broker.messages):  # own ones
            await anext(broker.messages)

    async def _retain(
        self, broker: aiomqtt.Client, topic: str, payload: bytes = b"", qos: int = 0
    ) -> None:
        expiring = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]  # of paho
        expiring.MessageExpiryInterval = self._expire
        payload = payload or self._retained.get(topic, b"")
        await broker.publish(topic, payload, qos, retain=True, properties=expiring)

    async def _publish(self, broker: aiomqtt.Client) -> None:
        """Publishes all that waits. The bridge is `offline` while a change waits for long."""
        while self._messages or self._pending or self._repeats:
            while self._messages:
                await broker.publish(*self._messages[0], qos=1)
                self._messages.popleft()
            waiting = self._pending or self._repeats
            topics = list(islice(waiting, BATCH))
            oldest = min((self._pending.get(topic, math.inf) for topic in topics), default=math.inf)
            if self._is_online and time.monotonic() - oldest > LATE:
                await self._tell(broker, False)
            for topic in topics:
                del waiting[topic]
            await asyncio.gather(*(self._retain(broker, topic) for topic in topics))
        if not self._is_online:
            await self._tell(broker, True)

    async def _publish_changes(self, broker: aiomqtt.Client) -> None:
        while True:
            again = time.monotonic() + self._expire / 3
            while (left := again - time.monotonic()) > 0:
                with suppress(TimeoutError):
                    async with asyncio.timeout(left):
                        await self._news.wait()
                self._news.clear()
                await self._publish(broker)
            self._repeats = dict.fromkeys(self._retained, 0.0)
            await self._tell(broker, self._is_online)

    async def _receive(self, broker: aiomqtt.Client, commands: Commands) -> None:
        async for message in broker.messages:
            if len(self._open) >= MOST_COMMANDS:
                say(f"too many commands wait: {message.topic} is dropped")
                continue
            task = asyncio.create_task(self._command(commands, message, time.monotonic()))
            self._open.add(task)
            task.add_done_callback(self._open.discard)

    async def _command(self, commands: Commands, message: aiomqtt.Message, arrived: float) -> None:
        key = str(message.topic).removeprefix(f"{self._root}/@set/")
        command: Known = {}
        try:
            command = parsed(message)
            outcome = await self._outcome(commands, key, command, arrived)
        except ValueError as error:
            outcome = {"outcome": "bad-value", "reason": str(error)}
        except sqlite3.Error as error:
            outcome = {"outcome": "busy", "reason": f"cannot record commands: {error}"}
        say(f"{key} = {command.get('value')}: {outcome['outcome']}")
        self._send(f"{self._root}/@outcome/{key}", {"id": command.get("id")} | outcome)

    async def _outcome(self, commands: Commands, key: str, command: Known, arrived: float) -> Known:
        number, value = command.get("id"), command["value"]
        turn = self._turns.setdefault(key, asyncio.Lock())
        async with turn:  # commands to a tag in their order
            if number and (known := commands.begin(key, number, json.dumps(value))):
                return known
            if key not in self.plant.tags:
                outcome = {"outcome": "unknown-tag", "reason": "no gateway has described this tag"}
            elif time.monotonic() - arrived > LATEST:
                outcome = {"outcome": "busy", "reason": "it waited longer than five seconds"}
            else:
                outcome = await self.plant.write(key, value, command.get("time"))
            if number:
                with suppress(sqlite3.Error):  # then a second delivery is `unclear`
                    commands.end(key, number, outcome)
            return outcome


async def bridge(
    gateways: Gateways, brokers: Sequence[str], root: str | None, expire: int, commands: Path | None
) -> None:
    """Serves until it is cancelled. `commands`: the file with the ids of commands, or no writes."""
    checked(brokers)
    with await opened(gateways) as session:
        served = Bridge(root or gateways.prefix, expire, commands)
        served.plant = RemotePlant(session, gateways.prefix, served.described, served.changed)
        async with asyncio.TaskGroup() as group:
            group.create_task(served.plant.follow())
            group.create_task(sessions(brokers, served.client, served.session))
