"""A gateway whose alarms reach people, also over failures of the server and of itself."""

import asyncio
import json
import signal
from pathlib import Path
from typing import Any

import pytest

from gateway.config import load
from gateway.errors import ConfigError
from gateway.parts.notify.message import Message, message
from gateway.parts.notify.outbox import Outbox
from gateway.parts.notify.watch import TEST
from gateway.stations.vigor import VigorStation
from tests.conftest import Command
from tests.e2e.processes import free_port, started, until, write_config
from tests.e2e.pty_modem import PATIENCE, PtyModem
from tests.notify.test_ways import Mailbox, mail_server
from tests.transport.modem import ModemModel
from tests.zenoh_peer import ZenohPeer, free_endpoint


def test_a_message_survives_a_dead_server_and_a_killed_gateway(
    command: Command, tmp_path: Path
) -> None:
    box, port = Mailbox(), free_port()
    tag = {"address": "D10", "write": True, "alarm": {"high": 30_000, "text": "Tank full"}}
    device = {"protocol": "vigor", "station": 1, "tags": {"level": tag}}
    config = write_config(
        tmp_path / "plant.yaml",
        free_endpoint(),
        {"hall": {"port": "simulator", "devices": {"mixer": device}}},
        alarms={"path": "alarms.json"},
        notify={
            "mail": {
                "server": f"smtp://127.0.0.1:{port}",
                "from": "gateway@plant.example",
                "to": ["shift@plant.example"],
            },
            "rules": [{"to": ["mail"], "alarms": ["mixer/level"]}],
        },
    )
    with started(config) as gateway:
        assert command("write", config, "mixer/level", "30001").code == 0
        gateway.says("alarm message not sent", "refused")
        until(lambda: "waiting" in _saved(config), "the message is saved")
        told = command("status", config)
        assert told.code == 1
        assert "mail does not work: connection refused; messages about alarms: 1" in told.out
        gateway.end(signal.SIGKILL)
    with mail_server(box, port=port), started(config) as gateway:
        gateway.says("alarm message sent", "mixer/level (simulated) raised: Tank full")
        assert command("status", config).code == 0
        assert command("write", config, "mixer/level", "1").code == 0
        gateway.says("alarm message sent", "mixer/level (simulated) ended: Tank full")
        assert command("notify", config).out == "mail: sent\n"
    assert len(box.mails) == 3
    missing = command("notify", config)
    assert (missing.code, missing.err) == (1, "mail: connection refused\n")
    assert command("notify", config, "pigeon").code == 2


async def test_b3_8_an_alarm_dials_a_telephone_again_that_was_busy(tmp_path: Path) -> None:
    far, endpoint, number = VigorStation(1), free_endpoint(), "0,26204393,,911"
    far.memory.write("D", 100, [17])
    model = ModemModel(
        ("CONNECT 9600", "BUSY", "OK"), answers=lambda data: b"".join(far.hear(data, 0.0))
    )
    level = {"address": "D10", "write": True, "alarm": {"high": 30_000}}
    slow = {"address": "D100", "every": "15min"}

    def device(tag: dict[str, Any]) -> dict[str, Any]:
        return {"protocol": "vigor", "station": 1, "tags": {"level": tag}}

    async with PtyModem(model) as modem:
        pumps = {
            "port": f"modem:{modem.path}",
            "modem": {"number": "26204400", "guard": "100ms", "idle": "200ms"},
            "devices": {"pump": device(slow)},
        }
        config = write_config(
            tmp_path / "plant.yaml",
            endpoint,
            {"hall": {"port": "simulator", "devices": {"mixer": device(level)}}, "pumps": pumps},
            alarms={"path": "alarms.json"},
            notify={
                "telephone": {"line": "pumps", "number": number},
                "rules": [{"to": ["telephone"], "alarms": ["mixer/level"], "ended": False}],
            },
        )
        with started(config):
            async with ZenohPeer("client", connect=[endpoint]) as client:
                values = await client.subscribe("plant/pump/level")
                read = await values.next(lambda sample: sample.json["value"] == 17)
                await modem.until_online(False)
                await client.get("plant/mixer/level/@set", b"30001")

                async def status(path: str) -> Any:
                    [document] = await client.get(f"plant/@gateway/demo/{path}")
                    return document.json

                async with asyncio.timeout(PATIENCE):
                    while not (way := await status("notify/telephone"))["sent"]:
                        await asyncio.sleep(0.1)
                assert (way["waiting"], way["failed"], way["trouble"]) == (0, 0, "")
                dialled = [one for one in model.commands if one.startswith("ATD")]
                assert dialled == ["ATDT26204400", *[f"ATDT{number};"] * 2]
                # The PLC of the line keeps its value, and no call of it is counted or tried.
                [now] = await client.get("plant/pump/level")
                assert now.json == read.json
                calls = (await status("lines/pumps"))["calls"]
                assert (calls["made"], calls["failed"], calls["last_result"]) == (1, 0, "complete")
                assert number.encode() not in model.data


def _saved(config: Path) -> str:
    path = config.with_name("notify.json")
    document: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    return "waiting" if document.get("waiting", {}).get("mail") else ""


@pytest.mark.parametrize(
    ("notify", "why"),
    [
        ({"rules": [{"to": ["mail"]}]}, "write `mail: ...` beside `rules` too"),
        ({"rules": [{"to": ["boss@plant"]}]}, "write `mail: {server: ..., from: ..., to: [...]}`"),
        ({"rules": [{"to": ["mial"]}], "command": ["x"]}, "'mial' is no way: did you mean mail?"),
        ({"rules": [{"to": ["a b@c"]}], "command": ["x"]}, "'a b@c' is no mail address"),
        ({"rules": []}, "at least 1"),
        ({"command": ["x"]}, "notify.rules: missing"),
        ({"command": ["x"], "rules": [{"to": ["command"], "between": "22-6"}]}, "22:00-06:00"),
        (
            {"webhook": {"url": "ftp://x"}, "rules": [{"to": ["webhook"]}]},
            "'ftp://x' is no server: write it as https://",
        ),
        (
            {"mqtt": {"broker": "mqtt://10.0.0.9", "user": "a"}, "rules": [{"to": ["mqtt"]}]},
            "user and password_file belong together",
        ),
        (
            {"webhook": {"url": "https://x", "secret_file": "no"}, "rules": [{"to": ["webhook"]}]},
            "no",
        ),
    ],
)
def test_a_mistake_is_named(tmp_path: Path, notify: dict[str, Any], why: str) -> None:
    device = {"protocol": "vigor", "station": 1, "tags": {"level": {"address": "D10"}}}
    lines = {"hall": {"port": "simulator", "devices": {"mixer": device}}}
    config = write_config(tmp_path / "plant.yaml", free_endpoint(), lines, notify=notify)
    with pytest.raises(ConfigError) as raised:
        load(config)
    assert why in str(raised.value)
    assert "notify" in str(raised.value)


def test_a_message_is_as_old_as_the_gateway_ran() -> None:
    """A wall clock that was ten years ahead for a moment dropped the alarms that waited."""
    box, after = Outbox(keep=60.0), Outbox(keep=60.0)
    old = message("plant", "demo", [TEST], 0)  # the year 1970
    box.put(old, 100.0)
    assert box.first(159.0) is old
    saved = box.saved(159.0)
    after.restore([(Message.restored(one), one["waited"]) for one in saved], 10.0)
    assert after.first(10.5) == old
    assert after.first(11.5) is None
    assert after.document()["dropped"] == 1
