"""The certificates of `plc-gateway ca`: a gateway and a client accept each other by them."""

import base64
import contextlib
import os
import signal
import socket
import ssl
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from gateway.cli.certificates import signing
from gateway.cli.certificates.authority import Authority, create
from gateway.cli.certificates.signing import Holder, Pair
from gateway.contract.access.certificates import expires
from gateway.contract.faults import faults
from gateway.errors import ConfigError
from tests.conftest import Command
from tests.e2e.processes import (
    Done,
    free_port,
    gateway,
    started,
    until,
    vigor_line,
    write_config,
)
from tests.zenoh_peer import configured, free_endpoint


def issued(folder: Path, holder: Holder, days: float = 825) -> None:
    """Makes a key and a certificate, and an authority for them if there is none."""
    if not (folder / "ca.key").exists():
        create(folder, 3650)
    Authority(folder).issue(holder, days)


def greets(port: int, folder: Path, called: str, *, refused: bool = False) -> None:
    """Connects to a gateway as `scada` of an authority. Raises `ssl.SSLError`.

    `refused`: waits for the refusal, which comes after the handshake.
    """
    context = ssl.create_default_context(cafile=folder / "ca.pem")
    context.load_cert_chain(folder / "scada.pem", folder / "scada.key")
    with (
        socket.create_connection(("127.0.0.1", port), 10) as plain,
        context.wrap_socket(plain, server_hostname=called) as opened,
    ):
        if refused:
            opened.recv(1)


def test_gateway_and_clients_know_each_other_by_their_certificates(
    command: Command, tmp_path: Path
) -> None:
    plant, other = tmp_path / "plant", tmp_path / "other"
    for folder in (plant, other):
        issued(folder, Holder("scada", is_client=True))
    (other / "ca.pem").write_bytes((plant / "ca.pem").read_bytes())
    issued(plant, Holder("gateway", ["10.0.0.5", "gateway.plant"]))
    endpoint = free_endpoint().replace("tcp/", "tls/")
    tls = {"ca": "plant/ca.pem", "certificate": "plant/gateway.pem", "key": "plant/gateway.key"}
    file = write_config(
        tmp_path / "c.yaml",
        endpoint,
        {"hall": vigor_line("simulator", {"speed": {"address": "D1"}})},
        zenoh={"prefix": "plant", "listen": [endpoint], "tls": {**tls, "mutual": True}},
    )
    port = int(endpoint.rpartition(":")[2])
    with started(file):
        for called in ("127.0.0.1", "localhost", "10.0.0.5", "gateway.plant"):
            greets(port, plant, called)
        with pytest.raises(ssl.SSLCertVerificationError, match="elsewhere"):
            greets(port, plant, "elsewhere")
        with pytest.raises(ssl.SSLError):
            greets(port, other, "gateway.plant", refused=True)
        # A session of Zenoh with the certificate of the client.
        file.write_text(file.read_text().replace("plant/gateway.", "plant/scada."))
        health = command("health", "--json", file)
        assert health.json["name"] == "demo"


def _plant(folder: Path, days: int) -> tuple[Path, Path]:
    """Makes an authority, and a gateway whose certificate has `days`."""
    pki = folder / "pki"
    _renew(pki, days)
    endpoint = free_endpoint().replace("tcp/", "tls/")
    tls = {"ca": "pki/ca.pem", "certificate": "pki/gateway.pem", "key": "pki/gateway.key"}
    device = {"protocol": "modbus-tcp", "tags": {"level": {"address": "holding:7"}}}
    boiler = {"port": f"tls://127.0.0.1:{free_port()}", "tls": tls, "devices": {"boiler": device}}
    file = write_config(
        folder / "c.yaml",
        endpoint,
        {"hall": vigor_line("simulator", {"speed": {"address": "D1"}}), "boiler": boiler},
        zenoh={"prefix": "plant", "listen": [endpoint], "tls": tls},
    )
    return file, pki


def _renew(pki: Path, days: int) -> None:
    """Makes a new certificate, in the place of the old one."""
    issued(pki, Holder("gateway", ["127.0.0.1"]), days)


def test_a_certificate_says_how_long_it_is_valid_and_is_renewed(
    command: Command, tmp_path: Path
) -> None:
    file, pki = _plant(tmp_path, 12)
    said = f"zenoh.tls.certificate {pki / 'gateway.pem'} expires in 12 d: renew it"
    checked = command("check", file)
    assert said in " ".join((checked.out + checked.err).split())
    with started(file) as program:
        status = command("health", "--strict", file)
        assert said in status.err
        _renew(pki, 200)
        os.kill(program.pid, signal.SIGHUP)
        program.says("gateway outdated", "the files of zenoh.tls were renewed")
        program.says("gateway starts over")
        until(lambda: _days(command("status", "--json", file)) > 199, "both are renewed")
        assert said not in command("health", "--strict", file).err


def _days(status: Done) -> float:
    """How long both certificates are valid, 0 while the gateway starts over and says nothing."""
    if not status.out:
        return 0
    found = status.json
    settings = ("certificate", "lines.boiler.tls.certificate")
    return min(float(found[f"certificates/{setting}"]["days"]) for setting in settings)


def test_files_that_do_not_fit_each_other_are_not_taken_over(
    command: Command, tmp_path: Path
) -> None:
    file, pki = _plant(tmp_path, 200)
    with started(file) as program:
        (pki / "gateway.key").write_bytes((pki / "ca.key").read_bytes())
        os.kill(program.pid, signal.SIGHUP)
        program.says("file reloaded")
        assert command("health", file).code == 0
        assert not program.has_said("gateway starts over")


@contextlib.contextmanager
def router(endpoint: str, pki: Path, *names: str) -> Iterator[zenoh.Session]:
    """A router that closes links whose certificate has ended. Only `names` may do anything."""
    tls = {
        "root_ca_certificate": str(pki / "ca.pem"),
        "listen_certificate": str(pki / "router.pem"),
        "listen_private_key": str(pki / "router.key"),
        "enable_mtls": True,
        "close_link_on_expiration": True,
    }
    messages = ["put", "query", "reply", "declare_subscriber", "declare_queryable"]
    rule = {"id": "all", "permission": "allow", "flows": ["ingress", "egress"]}
    access: dict[str, Any] = {
        "enabled": True,
        "default_permission": "deny",
        "rules": [{**rule, "messages": messages, "key_exprs": ["**", "works/@gateway/**"]}],
        "subjects": [{"id": "known", "cert_common_names": names}],
        "policies": [{"rules": ["all"], "subjects": ["known"]}],
    }
    config = {"transport/link/tls": tls, "access_control": access}
    setup = {"mode": "router", "listen": [endpoint], "connect": [], "config": config}
    with zenoh.open(configured(setup)) as session:
        yield session


def test_a_gateway_that_connects_takes_its_renewed_certificate_without_a_start(
    tmp_path: Path,
) -> None:
    """A link ends with its certificate, and the next one has the new one; a name that the router
    does not list gets nothing."""
    pki, endpoint = tmp_path / "pki", free_endpoint().replace("tcp/", "tls/")
    issued(pki, Holder("router", ["127.0.0.1"]))
    issued(pki, Holder("hall"))
    own = signing.private_key_of((pki / "hall.key").read_bytes())
    authority = Pair(
        signing.certificate_of((pki / "ca.pem").read_bytes()),
        signing.private_key_of((pki / "ca.key").read_bytes()),
    )

    def certify(name: str, days: float) -> None:
        made = signing.signed(authority, Holder(name), own.public_key(), days)
        (pki / "new").write_bytes(signing.pem(made))
        (pki / "new").replace(pki / "hall.pem")

    def answers(session: zenoh.Session) -> bool:
        found = session.get("works/@gateway/demo/status", timeout=5)
        return any(reply.ok is not None for reply in found)

    tls = {"ca": "pki/ca.pem", "certificate": "pki/hall.pem", "key": "pki/hall.key"}
    zenoh_section = {
        "prefix": "works",
        "mode": "client",
        "listen": [],
        "connect": [endpoint],
        "tls": {**tls, "mutual": True},
    }
    lines = {"hall": vigor_line("simulator", {"speed": {"address": "D1"}})}
    file = write_config(tmp_path / "c.yaml", endpoint, lines, zenoh=zenoh_section)
    with gateway("run", file) as program:
        with router(endpoint, pki, "hall") as session:
            program.says("Zenoh session ready")
            until(lambda: answers(session), "hall answers")
        certify("hall", 6 / 86_400)
        with router(endpoint, pki, "press") as session:
            ended = expires((pki / "hall.pem").read_bytes())
            until(lambda: bool(session.info.links()) or time.time() > ended, "hall is linked")
            assert not answers(session)
            certify("press", 100)
            until(lambda: answers(session), "press answers, on a new link")
        program.says("link up")
        assert not program.has_said("gateway starts over")


def test_an_expired_certificate_is_a_fault() -> None:
    expired = {"file": "hall.pem", "expires": None, "days": -3.2, "trouble": ""}
    said = "zenoh.tls.certificate hall.pem expired 3 d ago: Zenoh accepts no new connection"
    assert list(faults({"certificates/certificate": expired})) == [said]
    lost = {"file": "hall.pem", "expires": None, "days": None, "trouble": "Permission denied"}
    said = "zenoh.tls.ca hall.pem: Permission denied"
    assert list(faults({"certificates/ca": lost})) == [said]
    said = "lines.b.tls.ca hall.pem expired 3 d ago: the other side accepts no new connection"
    assert list(faults({"certificates/lines.b.tls.ca": expired})) == [said]


@given(st.binary(max_size=400))
def test_no_bytes_are_taken_for_a_certificate(content: bytes) -> None:
    text = (
        b"-----BEGIN CERTIFICATE-----\n"
        + base64.b64encode(content)
        + b"\n-----END CERTIFICATE-----\n"
    )
    for each in (content, text):
        with contextlib.suppress(ConfigError):
            assert isinstance(expires(each), float)
