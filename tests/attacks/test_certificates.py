"""The certificates of packaging/certificates: a gateway and a client accept each other by them."""

import json
import socket
import ssl
import subprocess
from pathlib import Path

import pytest

from tests.conftest import needs
from tests.e2e.processes import ROOT, plc_gateway, started, vigor_line, write_config
from tests.zenoh_peer import free_endpoint


def certificates(*arguments: object) -> None:
    needs("openssl")
    command = [str(ROOT / "packaging/certificates"), *map(str, arguments)]
    subprocess.run(command, check=True, capture_output=True)


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
        health = plc_gateway("health", file)
        assert json.loads(health.out)["name"] == "demo"
