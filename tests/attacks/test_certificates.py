"""The certificates of packaging/certificates: a gateway and a client accept each other by them."""

import base64
import contextlib
import json
import os
import signal
import socket
import ssl
import subprocess
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.contract.access.certificates import expires
from gateway.contract.faults import faults
from gateway.errors import ConfigError
from tests.conftest import needs
from tests.e2e.processes import (
    ROOT,
    free_port,
    plc_gateway,
    started,
    until,
    vigor_line,
    write_config,
)
from tests.zenoh_peer import free_endpoint


def certificates(*arguments: object, **environment: object) -> None:
    needs("openssl")
    command = [str(ROOT / "packaging/certificates"), *map(str, arguments)]
    changed = {name: str(value) for name, value in environment.items()}
    subprocess.run(command, check=True, capture_output=True, env={**os.environ, **changed})


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


def test_gateway_and_clients_know_each_other_by_their_certificates(tmp_path: Path) -> None:
    plant, other = tmp_path / "plant", tmp_path / "other"
    for folder in (plant, other):
        certificates("ca", folder)
        certificates("client", folder, "scada")
    (other / "ca.pem").write_bytes((plant / "ca.pem").read_bytes())
    certificates("gateway", plant, "gateway", "10.0.0.5", "gateway.plant")
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
        health = plc_gateway("health", "--json", file)
        assert json.loads(health.out)["name"] == "demo"


def _plant(folder: Path, days: int) -> tuple[Path, Path]:
    """Makes an authority, and a gateway whose certificate has `days`."""
    pki = folder / "pki"
    certificates("ca", pki)
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
    """Makes a new certificate, and puts it in the place of the old one."""
    for name in ("gateway.pem", "gateway.key"):
        (pki / name).unlink(missing_ok=True)
    certificates("gateway", pki, "gateway", "127.0.0.1", DAYS=days)


def test_a_certificate_says_how_long_it_is_valid_and_is_renewed(tmp_path: Path) -> None:
    file, pki = _plant(tmp_path, 12)
    said = f"zenoh.tls.certificate {pki / 'gateway.pem'} expires in 12 days: renew it"
    checked = plc_gateway("check", file)
    assert said in " ".join((checked.out + checked.err).split())
    with started(file) as program:
        status = plc_gateway("health", "--strict", file)
        assert said in status.err
        _renew(pki, 200)
        os.kill(program.pid, signal.SIGHUP)
        program.says("gateway outdated", "the files of zenoh.tls were renewed")
        program.says("gateway starts over")
        until(lambda: said not in plc_gateway("health", "--strict", file).err, "it is renewed")
        found = json.loads(plc_gateway("status", "--json", file).out)
        for setting in ("certificate", "lines.boiler.tls.certificate"):
            assert 199 < found[f"certificates/{setting}"]["days"] <= 200


def test_files_that_do_not_fit_each_other_are_not_taken_over(tmp_path: Path) -> None:
    file, pki = _plant(tmp_path, 200)
    with started(file) as program:
        (pki / "gateway.key").write_bytes((pki / "ca.key").read_bytes())
        os.kill(program.pid, signal.SIGHUP)
        program.says("file reloaded")
        assert plc_gateway("health", file).code == 0
        assert not program.has_said("gateway starts over")


def test_an_expired_certificate_is_a_fault() -> None:
    expired = {"file": "hall.pem", "expires": None, "days": -3.2, "trouble": ""}
    said = "zenoh.tls.certificate hall.pem expired 3 days ago: Zenoh accepts no new connection"
    assert list(faults({"certificates/certificate": expired})) == [said]
    lost = {"file": "hall.pem", "expires": None, "days": None, "trouble": "Permission denied"}
    said = "zenoh.tls.ca hall.pem: Permission denied"
    assert list(faults({"certificates/ca": lost})) == [said]
    said = "lines.b.tls.ca hall.pem expired 3 days ago: the other side accepts no new connection"
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
