"""The commands `ca` and `enrol`, as a person types them."""

import json
import ssl
import sys
from pathlib import Path

import pytest

from gateway.config import load
from tests.cli.conftest import documents
from tests.conftest import Command
from tests.e2e.processes import gateway, vigor_line
from tests.zenoh_peer import free_port


def test_a_person_makes_certificates_and_sees_them(command: Command, tmp_path: Path) -> None:
    pki = tmp_path / "pki"
    assert command("ca", "create", pki).out == f"{pki / 'ca.pem'}\n"
    made = command("ca", "issue", pki, "hall", "gateway.plant", "10.0.0.5", "--days", 90)
    assert made.out.startswith(f"{pki / 'hall.pem'}: valid until 20")
    assert command("ca", "issue", pki, "scada", "--client").code == 0
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH, cafile=pki / "ca.pem")
    context.load_cert_chain(pki / "hall.pem", pki / "hall.key")
    done = command("ca", "revoke", pki, "scada")
    assert "take scada out of the access control of the routers" in done.err
    context.load_verify_locations(pki / "revoked.pem")
    assert [line.split()[:2] for line in command("ca", "list", pki).out.splitlines()] == [
        *(["name", "state"], ["hall", "valid"], ["scada", "revoked"])
    ]
    [hall, scada] = documents(command("ca", "list", pki, "--json").out)
    assert hall["addresses"] == ["gateway.plant", "10.0.0.5"]
    assert scada["client"] is True
    [issued] = documents(command("ca", "issue", pki, "scada", "--client", "--json").out)
    assert issued["key"] == str(pki / "scada.key")
    assert {*issued} == {"certificate", "key", "until"}


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["ca", "issue", "DIR", "scada"], "first run plc-gateway ca create"),
        (["ca", "invite", "MADE", "hall"], "start plc-gateway ca serve"),
        (["ca", "issue", "MADE", "../x"], "is no name here"),
        (["ca", "issue", "MADE", "scada", "10.0.0.5", "--client"], "no addresses"),
        (["ca", "create", "MADE"], "has an authority"),
        (["enrol"], "write a code, or --renew"),
        (["enrol", "hall"], "no whole code"),
        (["enrol", "--renew", "--folder", "DIR"], "run plc-gateway enrol with a code first"),
    ],
)
def test_mistakes_are_named(
    command: Command, tmp_path: Path, arguments: list[str], says: str
) -> None:
    command("ca", "create", tmp_path / "made")
    folders = {"DIR": tmp_path / "none", "MADE": tmp_path / "made"}
    done = command(*(folders.get(word, word) for word in arguments))
    assert done.code == 2
    assert says in done.err


def test_without_its_package_the_command_names_it(
    command: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for module in ("authority", "signing", "state"):
        monkeypatch.delitem(sys.modules, f"gateway.cli.certificates.{module}", raising=False)
    monkeypatch.setitem(sys.modules, "cryptography", None)
    done = command("ca", "create", tmp_path)
    assert (done.code, "pip install cryptography" in done.err) == (2, True)


def test_a_gateway_enrols_with_the_code_that_a_person_carries(
    command: Command, tmp_path: Path
) -> None:
    pki, at = tmp_path / "pki", f"127.0.0.1:{free_port()}"
    command("ca", "create", pki, "--at", at)
    with gateway("ca", "serve", pki) as program:
        program.says("authority ready", at)
        code = command("ca", "invite", pki, "hall", "gateway.plant").out.strip()
        done = command("enrol", code, "--folder", tmp_path / "own")
        renew = "enrol", "--renew", "--folder", tmp_path / "own"
        assert command(*renew).out.endswith("need not be renewed\n")
        [renewed] = documents(command(*renew, "--json").out)
        assert {*renewed} == {"certificate", "key", "ca", "until", "new"}
        assert renewed["new"] is False
        [invited] = documents(command("ca", "invite", pki, "press", "--json").out)
        assert (invited["name"], invited["at"], invited["good"]) == ("press", at, 3600)
        [own] = documents(
            command("enrol", invited["code"], "--folder", tmp_path / "press", "--json").out
        )
        assert (own["certificate"], own["new"]) == (str(tmp_path / "press/press.pem"), True)
        assert program.end() == 0
    first, _, section = done.out.partition("\n")
    assert first.startswith(f"{tmp_path / 'own/hall.pem'}: valid until 20")
    file, lines = (
        tmp_path / "c.yaml",
        {"hall": vigor_line("simulator", {"speed": {"address": "D1"}})},
    )
    file.write_text(f"gateway: {{name: hall}}\nlines: {json.dumps(lines)}\n{section}")
    loaded = load(file)
    assert loaded.zenoh.tls is not None
    assert loaded.zenoh.tls.mutual
    again = command("enrol", "--renew", "--folder", tmp_path / "own")
    assert again.code == 1
    assert "does not answer" in again.err
