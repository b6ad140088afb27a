"""`bridge mqtt` with mosquitto: what a client of the broker sees, in every failure."""

import signal
import subprocess
from pathlib import Path
from typing import Any

from tests.bridges.conftest import Broker, bridge
from tests.bridges.played import PlayedGateway
from tests.e2e.processes import Program, free_port, started, until, vigor_line, write_config
from tests.zenoh_peer import free_endpoint

TAGS: dict[str, dict[str, Any]] = {
    "mixer/speed": {"type": "float64", "unit": "rpm"},
    "mixer/recipe": {"write": {"min": 1, "max": 40, "verify": False}},
    "mixer/raw": {"payload": "raw"},
    "oven/heat": {},
    "scanner/code": {"type": "string[8]", "event": True},
}


class Client:
    """mosquitto_sub and mosquitto_pub."""

    def __init__(self, port: int) -> None:
        self._port = str(port)
        self.seen = Program(
            *(
                "mosquitto_sub",
                "-h",
                "127.0.0.1",
                "-p",
                self._port,
                "-V",
                "5",
                "-t",
                "plant/#",
                "-v",
                "-q",
                "1",
            )
        )

    def publish(self, topic: str, payload: str, *options: str) -> None:
        command = (
            "mosquitto_pub",
            "-h",
            "127.0.0.1",
            "-p",
            self._port,
            "-V",
            "5",
            "-t",
            f"plant/{topic}",
        )
        subprocess.run([*command, "-m", payload, *options], check=True, timeout=300)

    def retained(self, *topics: str) -> list[str]:
        """Returns the topics that the broker has a value of; the last must have one."""
        asked = [word for topic in topics for word in ("-t", f"plant/{topic}")]
        command = (
            "mosquitto_sub",
            "-h",
            "127.0.0.1",
            "-p",
            self._port,
            "--retained-only",
            "-C",
            "1",
            "-v",
        )
        return subprocess.check_output([*command, *asked], text=True, timeout=300).split()


def _is_seen(gateway: PlayedGateway, seen: Program) -> bool:
    gateway.put("scanner/code", "A0")
    return seen.has_said("plant/scanner/code", "A0")


def test_a_client_of_the_broker_sees_no_good_value_that_is_not(
    mosquitto: Broker, tmp_path: Path
) -> None:
    port, endpoint = free_port(), free_endpoint()
    options = ("--connect", endpoint, "--broker", f"mqtt://127.0.0.1:{port}")
    with mosquitto(port) as broker, PlayedGateway(endpoint, TAGS) as gateway:
        client = Client(port)
        with client.seen as seen:
            gateway.put("mixer/speed", 12.5)
            with bridge("mqtt", *options) as first:
                seen.says("plant/@bridge", "online")
                seen.says("plant/mixer/speed", '"value": 12.5, "quality": "good"')
                assert '"unit": "rpm"' in seen.says("plant/@meta/mixer/speed")

                gateway.put("mixer/speed", None, "no-reply")
                seen.says("plant/mixer/speed", '"value": null', '"bad"', '"no-reply"')
                gateway.put("mixer/raw", 77)
                seen.says("plant/mixer/raw", '"value": 77', '"good"')
                gateway.put("mixer/raw", [1, 2.5])
                seen.says("plant/mixer/raw", '"value": [1, 2.5]', '"good"')
                until(lambda: _is_seen(gateway, seen), "events arrive")
                for code in ("A1", "A1", "B2"):  # an event is no last value
                    gateway.put("scanner/code", code)
                seen.says("plant/scanner/code", "B2")
                assert sum('"A1"' in line for line in seen.lines) == 2
                gateway.block("oven", heat=5)
                seen.says("plant/oven/heat", '"value": 5', '"good"')

                gateway.offline("mixer")
                seen.says("plant/mixer/raw", '"no-reply"')
                gateway.put("mixer/speed", 13.5)  # no token says that it is of now
                gateway.put("oven/heat", 6)
                seen.says("plant/oven/heat", '"value": 6')
                assert not seen.has_said("13.5")
                gateway.online("mixer")
                seen.says("plant/mixer/speed", "13.5", '"good"')
                first.end(signal.SIGKILL)
            seen.says("plant/@bridge", "offline")

            gateway.leave()  # the broker has kept good values
            after = len(seen.lines)
            with bridge("mqtt", *options, "--expire", 1) as second:
                seen.says("plant/mixer/speed", '"no-gateway"', after=after)
                seen.says("plant/oven/heat", '"no-gateway"', after=after)
                seen.says("plant/@bridge", "online", after=after)
                assert not any('"good"' in line for line in seen.lines[after:])
                gateway.documents["oven/heat"] = {"quality": "good", "value": [1]}  # no document
                gateway.arrive()
                seen.says("plant/oven/heat", '"garbled"', after=after)
                seen.says("plant/mixer/speed", "13.5", '"good"', after=after)
                assert not any(
                    "scanner/code" in line and "B2" in line for line in seen.lines[after:]
                )

                broker.end(signal.SIGKILL)
                after = len(seen.lines)
                with mosquitto(port):
                    seen.says("plant/mixer/speed", "13.5", '"good"', after=after)
                    seen.says("plant/@bridge", "online", after=after)
                    gateway.close()
                    seen.says("plant/mixer/speed", '"no-gateway"', after=after)
                    second.end(signal.SIGKILL)
                    seen.says("plant/@bridge", "offline", after=after)
                    # The broker forgets the values that no bridge repeats.
                    topics = ("mixer/speed", "@bridge")
                    gone = ["plant/@bridge", "offline"]
                    until(lambda: client.retained(*topics) == gone, "the value expires")


def test_a_command_is_written_once_and_has_its_outcome(mosquitto: Broker, tmp_path: Path) -> None:
    port, endpoint = free_port(), free_endpoint()
    options = ["--connect", endpoint, "--broker", f"mqtt://127.0.0.1:{port}", "--writes"]
    options += ["--commands", str(tmp_path / "commands.db")]
    with mosquitto(port), PlayedGateway(endpoint, TAGS) as gateway:
        client = Client(port)

        def outcome(payload: str, *how: str, topic: str = "mixer/recipe") -> str:
            after = len(client.seen.lines)
            client.publish(f"@set/{topic}", payload, *how)
            return client.seen.says(f"plant/@outcome/{topic}", after=after)

        with client.seen as seen:
            with bridge("mqtt", *options) as first:
                seen.says("plant/@bridge", "online")
                seen.says("plant/@meta/mixer/recipe")
                assert '"written"' in outcome("7")
                twice = '{"id": "a", "value": 8}'
                assert '"id": "a", "outcome": "written"' in outcome(twice, "-q", "1")
                assert '"id": "a", "outcome": "written"' in outcome(twice, "-q", "1")
                gateway.until_written(2)
                assert gateway.written == [("mixer/recipe", 7), ("mixer/recipe", 8)]
                # What could be done twice, or would come late, is not sent.
                assert '"bad-value"' in outcome("9", "-q", "1")
                assert '"bad-value"' in outcome("9", "-r")
                assert '"bad-value"' in outcome('{"id": "a", "value": 9}', "-q", "1")
                assert '"bad-value"' in outcome("seven")
                assert '"unknown-tag"' in outcome("1", topic="mixer/none")
                gateway.answer = "refused"
                assert '"refused"' in outcome("7")
                gateway.answer = "silent"
                assert '"unclear"' in outcome("7")
                gateway.until_written(4)
                assert len(gateway.written) == 4
                gateway.answer = "held"
                client.publish("@set/mixer/recipe", '{"id": "b", "value": 8}', "-q", "1")
                gateway.until_written(5)
                first.end(signal.SIGKILL)
            seen.says("plant/@bridge", "offline")
            gateway.answer = "written"
            after = len(seen.lines)
            with bridge("mqtt", *options):
                seen.says("plant/@bridge", "online", after=after)
                seen.says("plant/@meta/mixer/recipe", after=after)
                assert '"unclear"' in outcome('{"id": "b", "value": 8}', "-q", "1")
                assert '"written"' in outcome(twice, "-q", "1")
                assert len(gateway.written) == 5
                gateway.leave()
                assert '"no-gateway"' in outcome("7")
                assert len(gateway.written) == 5


def test_a_gateway_is_seen_and_written_through_the_broker(
    mosquitto: Broker, tmp_path: Path
) -> None:
    port, endpoint = free_port(), free_endpoint()
    tags = {"recipe": {"address": "D500", "write": {"max": 40, "verify": True}}}
    file = write_config(
        tmp_path / "c.yaml", endpoint, {"hall": vigor_line("simulator", tags, blocks="only")}
    )
    options = ["--connect", endpoint, "--broker", f"mqtt://127.0.0.1:{port}", "--writes"]
    options += ["--commands", str(tmp_path / "commands.db")]
    with mosquitto(port), started(file) as gateway:
        client = Client(port)
        with client.seen as seen, bridge("mqtt", *options) as program:
            seen.says("plant/@bridge", "online")
            seen.says("plant/mixer/recipe", '"good"')
            client.publish("@set/mixer/recipe", "7")
            done = seen.says("plant/@outcome/mixer/recipe")
            assert '"outcome": "written", "value": 7' in done
            assert '"verified": true' in done
            seen.says("plant/mixer/recipe", '"value": 7', '"good"')
            client.publish("@set/mixer/recipe", "41")
            seen.says("plant/@outcome/mixer/recipe", '"bad-value"')
            gateway.end(signal.SIGKILL)
            seen.says("plant/mixer/recipe", '"no-gateway"')
            assert program.end() == 0
            seen.says("plant/@bridge", "offline")
