"""A gateway whose alarms reach people, also over failures of the server and of itself."""

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
from tests.e2e.processes import free_port, plc_gateway, started, until, write_config
from tests.notify.test_ways import Mailbox, mail_server
from tests.zenoh_peer import free_endpoint


def test_a_message_survives_a_dead_server_and_a_killed_gateway(tmp_path: Path) -> None:
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
        assert plc_gateway("write", config, "mixer/level", "30001").code == 0
        gateway.says("alarm message not sent", "refused")
        until(lambda: "waiting" in _saved(config), "the message is saved")
        told = plc_gateway("status", config)
        assert told.code == 1
        assert "mail does not work: connection refused; messages about alarms: 1" in told.out
        gateway.end(signal.SIGKILL)
    with mail_server(box, port=port), started(config) as gateway:
        gateway.says("alarm message sent", "mixer/level (simulated) raised: Tank full")
        assert plc_gateway("status", config).code == 0
        assert plc_gateway("write", config, "mixer/level", "1").code == 0
        gateway.says("alarm message sent", "mixer/level (simulated) ended: Tank full")
        assert plc_gateway("notify", config).out == "mail: sent\n"
    assert len(box.mails) == 3
    missing = plc_gateway("notify", config)
    assert (missing.code, missing.err) == (1, "mail: connection refused\n")
    assert plc_gateway("notify", config, "pigeon").code == 2


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
