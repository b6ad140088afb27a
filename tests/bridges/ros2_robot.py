"""A program of ROS 2: prints the messages of a topic, and writes.

Run with the Python of tests/interop/ros2: `ros2_robot.py TOPIC SERVICE`. It prints each message as
JSON and `lost` when the publisher has gone. A line `TAG JSON` on its input writes.
"""

import json
import os
import sys
import threading

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile


def show(found: DiagnosticArray) -> None:
    [status] = found.status
    about = {one.key: one.value for one in status.values}
    said = [status.level[0], status.name, status.hardware_id, status.message, about]
    stamp = found.header.stamp
    print(json.dumps([*said, stamp.sec + stamp.nanosec / 1e9]), flush=True)


def parameter(name: str, value: object) -> Parameter:
    kind = {bool: "bool", int: "integer", float: "double", str: "string"}[type(value)]
    number = getattr(ParameterType, f"PARAMETER_{kind.upper()}")
    return Parameter(name=name, value=ParameterValue(**{"type": number, f"{kind}_value": value}))


def main() -> None:
    topic, service = sys.argv[1:]
    rclpy.init()
    node = rclpy.create_node("robot")
    gone = SubscriptionEventCallbacks(
        liveliness=lambda event: event.alive_count or print("lost", flush=True)
    )
    qos = QoSProfile(
        depth=10,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
        liveliness=LivelinessPolicy.AUTOMATIC,
        liveliness_lease_duration=Duration(seconds=3.0),
    )
    node.create_subscription(DiagnosticArray, topic, show, qos, event_callbacks=gone)
    client = node.create_client(SetParameters, service)
    threading.Thread(target=rclpy.spin, args=(node,)).start()
    for line in sys.stdin:
        tag, value = line.split(maxsplit=1)
        assert client.wait_for_service(300)
        request = SetParameters.Request(parameters=[parameter(tag, json.loads(value))])
        [result] = client.call(request).results
        print("ok", result.successful, result.reason, flush=True)
    os._exit(0)  # what ROS 2 has open is of no use to the test


if __name__ == "__main__":
    main()
