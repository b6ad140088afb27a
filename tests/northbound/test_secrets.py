"""Secrets: refused if readable by all, never shown; and warnings of open endpoints."""

import asyncio
import json
import sys
from pathlib import Path
from typing import Any

import pytest
import zenoh

from gateway.config import TlsConfig, ZenohConfig
from gateway.contract.access import secrets
from gateway.errors import ConfigError
from gateway.northbound.session import exposures
from gateway.northbound.session.session_settings import configure
from tests.e2e.processes import Program
from tests.northbound.access import (
    GATEWAY_RULES,
    PASSWORDS,
    as_user,
    certificates,
    rules,
    secret,
    users,
)
from tests.northbound.test_writers import ALICE, SECRET, signed
from tests.zenoh_peer import free_endpoint

RECIPE = "plant/mixer/recipe/@set"


@pytest.mark.parametrize("setting", ["password_file", "users_file", "key", "config_file"])
def test_a_secret_that_every_user_can_read_is_refused(tmp_path: Path, setting: str) -> None:
    file = tmp_path / "secret"
    file.write_text('{transport: {auth: {usrpwd: {user: "a", password: "hunter2-x"}}}}')
    if setting == "key":
        settings = ZenohConfig(tls=TlsConfig(certificate=tmp_path / "c.pem", key=file))
    else:
        settings = ZenohConfig(**{setting: file, "user": "gateway"})  # type: ignore[arg-type]  # by name
    file.chmod(0o644)
    with pytest.raises(
        ConfigError, match="is open to every user of this machine: run chmod"
    ) as one:
        configure(settings)
    assert "hunter2-x" not in str(one.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("viewer secret-x", "line 1: write it as name:password"),
        ("viewer:a\n# a note\noperator:secret-x", "line 2: write it as name:password"),
        ("viewer:\n", "line 1: write it as name:password"),
        (":secret-x\n", "line 1: write it as name:password"),
        ("", "names no user, so the gateway would accept every connection"),
        ("\n \n", "names no user, so the gateway would accept every connection"),
    ],
)
def test_a_users_file_without_valid_users_is_refused(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says) as raised:
        configure(ZenohConfig(users_file=secret(tmp_path / "users.txt", text)))
    assert "secret-x" not in str(raised.value)


def test_a_file_that_is_no_certificate_or_key_is_named(tmp_path: Path) -> None:
    signed = certificates(tmp_path)
    certificate, key = signed("gateway")
    _, other_key = signed("operator")
    none = secret(tmp_path / "none", "hello\n")
    for tls, says in (
        (TlsConfig(ca=none), f"zenoh.tls.ca {none} holds no certificate"),
        (TlsConfig(certificate=none, key=key), f"zenoh.tls.certificate {none} holds no"),
        (TlsConfig(certificate=certificate, key=none), f"zenoh.tls.key {none} is no PEM key"),
        (TlsConfig(certificate=certificate, key=other_key), f"not that of {certificate}"),
    ):
        with pytest.raises(ConfigError) as raised:
            configure(ZenohConfig(tls=tls))
        assert says in str(raised.value)


def test_the_password_comes_from_the_file_or_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def used(**settings: Any) -> object:
        config = configure(ZenohConfig(user="gateway", **settings))
        return json.loads(config.get_json("transport/auth/usrpwd/password"))

    monkeypatch.delenv(secrets.PASSWORD_VARIABLE, raising=False)
    with pytest.raises(ConfigError, match=r"zenoh\.user gateway has no password"):
        used()
    with pytest.raises(ConfigError, match="empty first line"):
        used(password_file=secret(tmp_path / "empty", "\n"))
    monkeypatch.setenv(secrets.PASSWORD_VARIABLE, "of the environment")
    assert used() == "of the environment"
    assert used(password_file=secret(tmp_path / "p", "of the file\nmore")) == "of the file"


@pytest.mark.parametrize(
    "text",
    [
        '{transport:{auth:{usrpwd:{user:"a",password:"hunter2-x" "b"}}}}',
        '{transport:{auth:{usrpwd:"hunter2-x"}}}',
        '{mode: 3, transport:{auth:{usrpwd:{user:"a",password:{"hunter2-x":1}}}}}',
    ],
)
def test_no_message_quotes_a_zenoh_file_that_may_hold_a_password(tmp_path: Path, text: str) -> None:
    with pytest.raises(ConfigError, match="it may hold a password") as raised:
        configure(ZenohConfig(config_file=secret(tmp_path / "zenoh.json5", text)))
    assert "hunter2-x" not in str(raised.value)


async def test_the_gateway_prints_and_serves_no_secret(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    zenoh_file = secret(
        tmp_path / "zenoh.json5",
        '{transport: {auth: {usrpwd: {user: "gateway", password: "in-the-zenoh-file"}}}}',
    )
    users_file = users(tmp_path)
    users_file.write_text(users_file.read_text() + "gateway2:in-the-users-file\n")
    config = {
        "gateway": {"name": "demo"},
        "zenoh": {
            "listen": [endpoint],
            "config_file": str(zenoh_file),
            "user": "gateway2",
            "password_file": str(secret(tmp_path / "password", "in-the-password-file")),
            "users_file": str(users_file),
        },
        "writers": {"file": str(secret(tmp_path / "writers", ALICE))},
        "lines": {"hall": {"port": "simulator", "devices": {"mixer": {
            "protocol": "vigor", "station": 1,
            "tags": {"recipe": {"address": "D500", "write": True}}}}}},
    }  # fmt: skip
    file = tmp_path / "plant.yaml"
    file.write_text(json.dumps(config))
    served: list[bytes] = []
    command = (sys.executable, "-m", "gateway", "run", file, "--log-level", "debug")
    with Program(*command) as program:
        await asyncio.to_thread(program.says, "Zenoh session ready")
        async with as_user("operator", endpoint) as client:
            received = await client.subscribe("plant/@gateway/**")
            for attachment in (None, b"wrong-token-of-a-client", SECRET.encode()):
                served += [r.payload for r in await client.get(RECIPE, b"7", attachment=attachment)]
            while b'"written"' not in b"".join(s.payload for s in received.samples):
                attachment = signed(b"7")  # the first ones are too near to the start
                served += [r.payload for r in await client.get(RECIPE, b"7", attachment=attachment)]
            for selector in ("plant/**", "plant/**/@meta", "plant/@gateway/**"):
                served += [r.payload for r in await client.get(selector, consolidation="NONE")]
            await received.next(lambda sample: sample.json.get("by") == "alice")
            served += [sample.payload for sample in received.samples]
        with RefusedConnection(endpoint):
            pass
        assert await asyncio.to_thread(program.end) == 0
    output = "\n".join(program.lines) + "\n".join(data.decode() for data in served)
    assert "written" in output
    assert len(served) > 8
    for word in (
        *PASSWORDS.values(),
        "in-the-zenoh-file",
        "in-the-users-file",
        "in-the-password-file",
        "wrong-token-of-a-client",
        SECRET,
    ):
        assert word not in output, word


class RefusedConnection:
    """A connection attempt with a wrong password, which the gateway may log."""

    def __init__(self, endpoint: str) -> None:
        self._endpoint = endpoint

    def __enter__(self) -> None:
        config = zenoh.Config()
        for path, value in {
            "mode": "client",
            "connect/endpoints": [self._endpoint],
            "connect/timeout_ms": 300,
            "scouting/multicast/enabled": False,
            "transport/auth/usrpwd/user": "operator",
            "transport/auth/usrpwd/password": PASSWORDS["viewer"],
        }.items():
            config.insert_json5(path, json.dumps(value))
        with pytest.raises(zenoh.ZError):
            zenoh.open(config)

    def __exit__(self, *_error: object) -> None:
        pass


@pytest.mark.parametrize(
    ("listen", "setup", "says"),
    [
        ("tcp/127.0.0.1:7447", {}, []),
        ("tcp/[::1]:7447", {}, []),
        ("tcp/localhost:7447", {}, []),
        ("unixsock-stream//tmp/s", {}, []),
        ("tcp/0.0.0.0:7447", {}, ["nothing protects it"]),
        ("tcp/[::]:7447", {}, ["nothing protects it"]),
        ("tcp/10.0.0.5:7447#iface=eth0", {}, ["nothing protects it"]),
        ("tls/0.0.0.0:7447", {}, ["nothing protects it"]),  # encrypted, yet open
        ("tls/0.0.0.0:7447", {"transport/link/tls/enable_mtls": True}, []),
        ("tls/0.0.0.0:7447", {"transport/auth/usrpwd/dictionary_file": "users"}, []),
        ("tcp/0.0.0.0:7447", {"transport/auth/usrpwd/dictionary_file": "users"}, ["in the clear"]),
        ("tcp/0.0.0.0:7447", {"access_control": rules(GATEWAY_RULES)}, []),
        (
            "tcp/0.0.0.0:7447",
            {"access_control": rules(GATEWAY_RULES) | {"default_permission": "allow"}},
            ["nothing protects it"],
        ),
    ],
)
def test_an_unprotected_endpoint_gives_a_warning(
    listen: str, setup: dict[str, Any], says: list[str]
) -> None:
    config = configure(ZenohConfig())
    for path, value in {"listen/endpoints": [listen], **setup}.items():
        config.insert_json5(path, json.dumps(value))
    warnings = exposures.exposures(config)
    assert len(warnings) == len(says)
    for sentence, words in zip(warnings, says, strict=True):
        assert words in sentence
        assert listen in sentence
