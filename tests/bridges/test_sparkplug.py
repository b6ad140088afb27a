"""`bridge mqtt --sparkplug` with mosquitto, and with a host written from the specification."""

import json
import re
import signal
import subprocess
from types import SimpleNamespace
from typing import Any

import pytest

from gateway.bridges.mqtt.sparkplug.messages import Payload
from gateway.bridges.mqtt.sparkplug.metrics import fill, value_of
from gateway.bridges.mqtt.sparkplug.node import EdgeNode
from gateway.errors import BadValue
from tests.bridges.conftest import INTEROP, Broker, bridge
from tests.bridges.played import META, PlayedGateway, document
from tests.bridges.sparkplug_host import CHECKS, SparkplugHost, command, decoded, quality
from tests.bridges.sparkplug_rules import BY_HOST, BY_TEST, NOT_CHECKED
from tests.conftest import lacking, needs
from tests.e2e.processes import free_port, plc_gateway
from tests.zenoh_peer import free_endpoint

TAGS: dict[str, dict[str, Any]] = {
    "mixer/speed": {"type": "float64", "unit": "rpm", "description": "of the drum"},
    "mixer/motor/recipe": {"write": {"min": -40, "max": 40, "verify": False}},
    "mixer/total": {"type": "uint64"},
    "mixer/steps": {"type": "int16[2]", "length": 2},
    "oven/heat": {"type": "int16"},
    "scanner/code": {"type": "string[8]", "event": True},
}


def test_each_check_of_the_host_has_the_rules_that_it_is_for() -> None:
    assert list(BY_HOST) == list(CHECKS)
    rules = " ".join([*BY_HOST.values(), *BY_TEST.values(), *NOT_CHECKED]).split()
    assert len(rules) == len(set(rules))


def test_a_host_sees_births_deaths_and_nothing_good_that_is_not(mosquitto: Broker) -> None:
    port, endpoint = free_port(), free_endpoint()
    options = ["--connect", endpoint, "--broker", f"mqtt://127.0.0.1:{port}", "--writes"]
    options += ["--sparkplug", "hall", "--node", "line-1"]
    with (
        PlayedGateway(endpoint, TAGS) as gateway,
        SparkplugHost(port, "hall", "line-1") as host,
    ):

        def sees(key: str, value: object) -> None:
            host.until(lambda: host.values.get(key) == value, f"{key} is {value}")

        with mosquitto(port) as broker:
            gateway.put("mixer/speed", 12.5)
            gateway.put("mixer/total", 2**64 - 1)
            with bridge("mqtt", *options) as first:
                sees("mixer/speed", 12.5)
                sees("mixer/total", 2**64 - 1)
                broker.says("as gateway-hall-line-1 (p2, c1,")  # MQTT 3.1.1, a clean session
                broker.says("Will message specified", "(r0, q1)")
                for kind in ("NCMD/line-1", "DCMD/line-1/+"):
                    broker.says(f"spBv1.0/hall/{kind} (QoS 1)")
                gateway.put("oven/heat", -5)
                sees("oven/heat", -5)
                gateway.put("mixer/steps", [-1, 2])
                sees("mixer/steps", b"\xff\xff\x02\x00")
                gateway.put("mixer/speed", None, "overdue")
                sees("mixer/speed", None)
                gateway.put("oven/heat", 70_000)  # more than its type
                sees("oven/heat", None)
                gateway.put("scanner/code", "A1")
                sees("scanner/code", "A1")

                gateway.put("mixer/speed", 13.5)
                sees("mixer/speed", 13.5)
                gateway.offline("mixer")
                host.until(lambda: "mixer" not in host.alive(), "the device died")
                assert host.values["mixer/speed"] is host.values["mixer/steps"] is None
                gateway.online("mixer")
                sees("mixer/speed", 13.5)

                # A rebirth: everything again, and the last event is none of now.
                before = len(host.messages)
                host.send(command("Node Control/Rebirth", boolean=True))
                host.until(lambda: "NBIRTH" in host.kinds()[before:], "the node is born again")
                host.until(
                    lambda: host.kinds()[before:].count("DBIRTH") == 3, "the devices are, too"
                )
                assert host.values["scanner/code"] is None
                sees("mixer/speed", 13.5)
                host.send(command("Node Control/Rebirth", boolean=False))
                host.send(b"\xff no payload")

                # Commands: once, with the sign of the type, never from what MQTT may repeat.
                host.send(command("motor/recipe", int=7), "mixer")
                gateway.until_written(1)
                [alias] = [
                    alias for alias, (key, _) in host.aliases.items() if key == "mixer/motor/recipe"
                ]
                host.send(command("", alias=alias, int=2**32 - 5), "mixer")
                gateway.until_written(2)
                host.send(command("motor/recipe", int=8), "mixer", qos=1)
                first.says("MQTT may deliver it again")
                host.send(command("motor/recipe", is_null=True), "mixer")
                first.says("null cannot be written")
                host.send(command("", alias=alias, int=9), "oven")
                first.says("there is no such metric")
                host.send(command("motor/recipe", double=float("nan")), "mixer")
                first.says("is no number")
                gateway.answer = "refused"
                host.send(command("motor/recipe", int=9), "mixer")
                first.says("mixer/motor/recipe = 9: refused")
                gateway.until_written(3)
                assert [value for _, value in gateway.written] == [7, -5, 9]

                first.end(signal.SIGKILL)
                host.until(lambda: not host.is_online, "the node died")
            assert not [value for value in host.values.values() if value is not None]
            with bridge("mqtt", *options) as second:
                sees("mixer/speed", 13.5)
                broker.end(signal.SIGKILL)
                host.until(lambda: not host.is_online, "the broker has gone")
                gateway.put("mixer/speed", 14.5)
                second.says("broker:")
                with mosquitto(port):
                    sees("mixer/speed", 14.5)
                    assert host.bd_seq > host.last_bd_seq == 0
                    gateway.close()
                    host.until(lambda: host.alive() == set(), "the devices died")
                    assert second.end() == 0
                    host.until(lambda: not host.is_online, "the node said that it ends")
        assert host.wrong == []
        assert set(CHECKS) - host.checked == set()


def test_a_node_lives_only_while_its_primary_host_does(mosquitto: Broker) -> None:
    ports, endpoint = (free_port(), free_port()), free_endpoint()
    options = ["--connect", endpoint, "--sparkplug", "hall", "--node", "line-1", "--host", "scada"]
    for port in ports:
        options += ["--broker", f"mqtt://127.0.0.1:{port}"]
    with (
        mosquitto(ports[0]) as broker,
        mosquitto(ports[1]) as spare,
        PlayedGateway(endpoint, TAGS) as gateway,
        SparkplugHost(ports[0], "hall", "line-1") as host,
        SparkplugHost(ports[1], "hall", "line-1") as other,
        bridge("mqtt", *options) as program,
    ):
        gateway.put("mixer/speed", 12.5)
        broker.says("spBv1.0/STATE/scada (QoS 1)")
        program.says("gateway demo is there")
        assert host.messages == []
        host.say(online=False, at=10)
        host.say(online=True, at=9)  # older than the last one
        assert host.messages == []
        host.say(online=True, at=10)
        host.until(lambda: host.values.get("mixer/speed") == 12.5, "the node is born")
        host.say(online=False, at=9)
        gateway.put("mixer/speed", 13.5)
        host.until(lambda: host.values.get("mixer/speed") == 13.5, "the node lives")
        host.say(online=False, at=11)
        host.until(lambda: host.kinds()[-1] == "NDEATH", "the node died")
        spare.says("spBv1.0/STATE/scada (QoS 1)")  # the next broker
        other.say(online=True, at=1)
        other.until(lambda: other.values.get("mixer/speed") == 13.5, "the node is born there")
        assert host.wrong == other.wrong == []
        assert host.kinds().count("NDEATH") == 1


@pytest.mark.parametrize("ids", [("a+b", "n"), ("g", "a/b"), ("g", "#"), ("", "n")])
def test_ids_that_no_topic_can_have_are_refused(ids: tuple[str, str]) -> None:
    done = plc_gateway("bridge", "mqtt", "--sparkplug", ids[0], "--node", ids[1])
    assert (done.code, "is no id of Sparkplug" in done.err) == (2, bool("".join(ids)))


# ---- values ------------------------------------------------------------------------------------

VALUES: list[tuple[str, Any, dict[str, Any]]] = [  # type, value, the fields on the wire
    ("int8", -5, {"int": 2**32 - 5}),
    ("int16", -30000, {"int": 2**32 - 30000}),
    ("int32", -(2**31), {"int": 2**31}),
    ("int64", -1, {"long": 2**64 - 1}),
    ("uint8", 255, {"int": 255}),
    ("bcd16", 9999, {"int": 9999}),
    ("uint32", 2**32 - 1, {"long": 2**32 - 1}),
    ("uint64", 2**64 - 1, {"long": 2**64 - 1}),
    ("float32", 0.5, {"float": 0.5}),
    ("float64", 7, {"double": 7.0}),
    ("bool", True, {"boolean": 1}),
    ("string[8]", "Ä\0\n", {"string": "Ä\0\n"}),
    # Arrays: the examples of the specification.
    ("int8[2]", [-23, 123], {"bytes": b"\xe9\x7b"}),  # its example has EF, which is -17
    ("int16[2]", [-30000, 30000], {"bytes": b"\xd0\x8a\x30\x75"}),
    ("int32[2]", [-1, 315338746], {"bytes": bytes.fromhex("ffffffff faafcb12")}),
    ("uint8[2]", [23, 250], {"bytes": b"\x17\xfa"}),
    ("uint16[2]", [30, 52360], {"bytes": bytes.fromhex("1e00 88cc")}),
    ("uint32[2]", [52, 3293969225], {"bytes": bytes.fromhex("34000000 49fb55c4")}),
    (
        "bool[12]",
        [bool(int(bit)) for bit in "001101001101"],
        {"bytes": bytes.fromhex("0c000000 34d0")},
    ),
]
BAD: list[tuple[str, Any]] = [
    ("int16", 2**15),
    ("uint8", -1),
    ("int64", 2**63),
    ("uint64", 2**64),
    ("float32", 1e300),
    ("int16", 1.5),
    ("int16", "7"),
    ("bool", 1),
    ("string[8]", 7),
    ("int16[2]", [1, 70000]),
    ("int16[2]", 7),
    ("int16", [7]),
]


def meta_of(kind: str) -> dict[str, Any]:
    [length] = re.findall(r"\[(\d+)\]", kind) or [None]
    return META | {"type": kind} | ({"length": int(length)} if length and kind[0] != "s" else {})


def metric_of(kind: str, value: Any) -> Any:
    metric = Payload().metrics.add()
    fill(metric, document(value), meta_of(kind))
    return metric


@pytest.mark.parametrize(("kind", "value", "fields"), VALUES, ids=[one[0] for one in VALUES])
def test_a_value_is_sent_as_the_specification_says_and_read_back(
    kind: str, value: Any, fields: dict[str, Any]
) -> None:
    metric = metric_of(kind, value)
    payload = Payload(timestamp=1)
    payload.metrics.append(metric)
    [found] = decoded(payload.SerializeToString())["metrics"]
    assert found.items() >= fields.items()
    assert quality(found) == 192
    assert value_of(metric, meta_of(kind)) == value


@pytest.mark.parametrize(("kind", "value"), BAD)
def test_a_value_that_its_type_cannot_hold_is_bad(kind: str, value: Any) -> None:
    metric = metric_of(kind, value)
    payload = Payload(timestamp=1)
    payload.metrics.append(metric)
    [found] = decoded(payload.SerializeToString())["metrics"]
    assert (found["is_null"], quality(found)) == (1, 0)


@pytest.mark.parametrize(
    ("kind", "fields"),
    [
        ("int16", {}),
        ("int16", {"is_null": True, "int_value": 7}),
        ("int16", {"int_value": 7, "long_value": 7}),
        ("int16", {"int_value": 2**17}),
        ("float64", {"double_value": float("inf")}),
        ("int16[2]", {"bytes_value": b"\1\0"}),
        ("int16[2]", {"bytes_value": b"\1\0\2\0", "datatype": 26}),
        ("bool[12]", {"bytes_value": b"\x0c\0\0\0\x34"}),
        ("bool[12]", {"bytes_value": b""}),
        ("float32[1]", {"bytes_value": bytes.fromhex("0000c07f")}),  # not a number
    ],
)
def test_a_command_without_one_plain_value_is_refused(kind: str, fields: dict[str, Any]) -> None:
    with pytest.raises(BadValue):
        value_of(Payload().metrics.add(**fields), meta_of(kind))


@pytest.mark.parametrize("sent", [2**32 - 5, 2**16 - 5])  # both are in use
def test_a_negative_number_is_read_at_any_width(sent: int) -> None:
    assert value_of(Payload().metrics.add(int_value=sent, datatype=2), meta_of("int16")) == -5
    assert value_of(Payload().metrics.add(int_value=sent, datatype=7), meta_of("int16")) == sent


def test_the_library_of_eclipse_tahu_reads_a_birth_and_its_commands_are_read() -> None:
    program = needs("node")
    if not (INTEROP / "node_modules" / "sparkplug-payload").is_dir():
        lacking("npm's sparkplug-payload is not installed (npm ci in tests/interop)")
    plain = {kind: value for kind, value, fields in VALUES if "bytes" not in fields}
    tags = {f"mixer/{kind}": meta_of(kind) for kind in plain}
    known = {f"mixer/{kind}": document(value) for kind, value in plain.items()}
    plant: Any = SimpleNamespace(tags=tags, values=known)
    node = EdgeNode("hall", "line-1", plant)
    for key in tags:
        node.describe(key)
    node.connecting()
    node.birth()
    _, birth = node.device_birth("mixer")
    done = subprocess.run(
        [program, INTEROP / "sparkplug_payload.js"],
        input=birth.hex(),
        capture_output=True,
        text=True,
        check=True,
        timeout=300,
    )
    values, command_hex = json.loads(done.stdout)
    payload = Payload()
    payload.ParseFromString(bytes.fromhex(command_hex))
    by_name = {metric.name: metric for metric in payload.metrics}
    for kind, value in plain.items():
        assert values[kind] in (value, str(value))  # 64 bits: a text
        assert value_of(by_name[kind], meta_of(kind)) == value
