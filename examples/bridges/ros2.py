"""ROS 2: values of the gateway as topics, and a service that writes.

    source /opt/ros/kilted/setup.bash
    pip install --no-deps --no-build-isolation .
    python3 examples/bridges/ros2.py --connect tcp/127.0.0.1:7447

The tag `mixer/speed` is the topic `/plant/mixer/speed`, of diagnostic_msgs/DiagnosticArray: a
message of every ROS 2 that has a quality. It contains one status:

| field | content |
|---|---|
| `header.stamp` | the time of the reading |
| `level` | OK: good. WARN: uncertain, simulated or replayed. ERROR: bad. STALE: unknown |
| `message` | `good`, or the reason |
| `name`, `hardware_id` | the tag, the device |
| `values` | `value` as JSON, if there is one; `quality`, `unit`, `origin`, `limited` |

Use a value only while its level is OK and the bridge is there. Each topic is repeated every five
seconds. If the bridge is killed, its liveliness is lost after three seconds; if it stands still,
the deadline of 15 seconds is missed. A subscriber that asks for both gets an event.

A character that ROS 2 does not permit in a topic is `_`. Of two tags with one topic the second one
is not published. A tag with `event: true` is not repeated, and not kept for late subscribers.

With `--writes` the service `/plant/set` (rcl_interfaces/SetParameters) writes: the name of a
parameter is a tag. `successful` is true only when the device has acknowledged. Otherwise `reason`
begins with an error of docs/zenoh.md, or with `unclear`: it may or may not have been done. So do
not repeat it. No response means the same. Everyone who may call the service may then write.
"""

import argparse
import asyncio
import json
import re
import threading
import time
from collections.abc import Coroutine
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException
from rclpy.parameter import parameter_value_to_python
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions

from gateway.bridges.documents import Known, bad
from gateway.bridges.program import Gateways, opened, run, say
from gateway.bridges.remote_plant import RemotePlant

REPEAT_EVERY = 5.0  # seconds
LATEST = 5.0  # seconds: a write that waited longer is not sent
STATE = QoSProfile(
    depth=1,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
    deadline=Duration(seconds=3 * REPEAT_EVERY),
    liveliness=LivelinessPolicy.AUTOMATIC,
    liveliness_lease_duration=Duration(seconds=3.0),
)
EVENT = QoSProfile(depth=100)
UNKNOWN = ("starting", "no-gateway", "no-bridge")


def topic_of(prefix: str, key: str) -> str:
    chunks = (re.sub(r"[^A-Za-z0-9_]", "_", chunk) for chunk in f"{prefix}/{key}".split("/"))
    return "".join(f"/_{chunk}" if chunk[:1].isdigit() else f"/{chunk}" for chunk in chunks)


def message_of(key: str, known: Known, unit: str) -> DiagnosticArray:
    quality, origin = known["quality"], known.get("origin")
    word = known.get("reason", quality)
    level = DiagnosticStatus.OK
    if quality == "bad":
        level = DiagnosticStatus.STALE if word in UNKNOWN else DiagnosticStatus.ERROR
    elif quality != "good":
        level = DiagnosticStatus.WARN
    elif origin in ("simulated", "replayed"):
        level, word = DiagnosticStatus.WARN, origin
    about = {"quality": quality, "unit": unit, "origin": origin, "limited": known.get("limited")}
    if quality != "bad":
        about["value"] = json.dumps(known["value"], ensure_ascii=False)
    status = DiagnosticStatus(level=level, name=key, message=word)
    status.hardware_id = key.partition("/")[0]
    status.values = [KeyValue(key=name, value=text) for name, text in about.items() if text]
    found = DiagnosticArray(status=[status])
    seconds = datetime.fromisoformat(known["time"]).timestamp()
    found.header.stamp.sec = int(seconds)
    found.header.stamp.nanosec = round(seconds % 1 * 1e6) * 1000 % 10**9
    return found


class Bridge:
    def __init__(self, node: Any, prefix: str) -> None:
        self.plant: RemotePlant
        self._node, self._prefix = node, prefix
        self._loop = asyncio.get_running_loop()
        self._keys: dict[str, str] = {}  # by topic
        self._publishers: dict[str, Any] = {}  # by key

    def described(self, key: str, meta: Known) -> None:
        topic = topic_of(self._prefix, key)
        if (other := self._keys.setdefault(topic, key)) != key:
            say(f"{key} is not published: {topic} is the topic of {other}")
        elif key not in self._publishers:
            qos = EVENT if meta.get("event") else STATE
            self._publishers[key] = self._node.create_publisher(DiagnosticArray, topic, qos)

    def changed(self, key: str, known: Known) -> None:
        if publisher := self._publishers.get(key):
            publisher.publish(message_of(key, known, self.plant.tags[key]["unit"]))

    async def repeat(self) -> None:
        while True:
            await asyncio.sleep(REPEAT_EVERY)
            self._every_state({})

    def end(self) -> None:
        self._every_state(bad("no-bridge"))

    def _every_state(self, instead: Known) -> None:
        for key, known in self.plant.values.items():
            if not self.plant.tags[key].get("event"):
                self.changed(key, instead or known)

    # -- the thread of ROS 2 --

    async def set(
        self, request: SetParameters.Request, response: SetParameters.Response
    ) -> SetParameters.Response:
        arrived = time.monotonic()
        for one in request.parameters:
            value = None
            with suppress(RuntimeError):  # a type that ROS 2 does not have
                value = parameter_value_to_python(one.value)
            outcome = await self._in_loop(self._write(one.name, value, arrived))
            word, why = outcome["outcome"], outcome.get("reason", "")
            say(f"{one.name} = {value}: {word}")
            result = SetParametersResult(successful=word == "written", reason=f"{word}: {why}")
            response.results.append(result)
        return response

    async def _in_loop(self, work: Coroutine[Any, Any, Known]) -> Known:
        ended, executor = rclpy.Future(), self._node.executor
        doing = asyncio.run_coroutine_threadsafe(work, self._loop)
        doing.add_done_callback(lambda done: ended.set_result(done.result()) or executor.wake())
        outcome: Known = await ended
        return outcome

    def spin(self) -> None:
        with suppress(ExternalShutdownException):
            rclpy.spin(self._node)

    async def _write(self, key: str, value: object, arrived: float) -> Known:
        if not isinstance(value, bool | int | float | str):
            value = list(value) if hasattr(value, "typecode") else None  # an array of numbers
        if value is None:
            return {"outcome": "bad-value", "reason": "a write needs numbers, a bool or a text"}
        if time.monotonic() - arrived > LATEST:
            return {"outcome": "busy", "reason": "it waited longer than five seconds: not sent"}
        return await self.plant.write(key, value)


async def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--connect", nargs="+", default=["tcp/127.0.0.1:7447"], metavar="ENDPOINT")
    parser.add_argument("--zenoh", type=Path, metavar="FILE", help="a Zenoh file: user, TLS, …")
    parser.add_argument("--prefix", default="plant", help="of the gateways (default: plant)")
    parser.add_argument("--writes", action="store_true", help="offer the service that writes")
    given = parser.parse_args()
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("plc_gateway", enable_rosout=False, start_parameter_services=False)
    bridge = Bridge(node, given.prefix)
    spinning = threading.Thread(target=bridge.spin)
    try:
        with await opened(Gateways(given.connect, given.zenoh, given.prefix)) as session:
            bridge.plant = RemotePlant(session, given.prefix, bridge.described, bridge.changed)
            if given.writes:
                node.create_service(SetParameters, topic_of(given.prefix, "set"), bridge.set)
            spinning.start()
            say("connected to ROS 2")
            async with asyncio.TaskGroup() as group:
                group.create_task(bridge.plant.follow())
                group.create_task(bridge.repeat())
    finally:
        if spinning.is_alive():
            bridge.end()
        rclpy.shutdown()


if __name__ == "__main__":
    run(main())
