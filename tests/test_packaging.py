"""The files of packaging/: systemd, container, Kubernetes."""

import re
import subprocess
from pathlib import Path

import pytest
import yaml

from gateway.config import load
from tests.conftest import needs
from tests.e2e.processes import ROOT

PACKAGING = ROOT / "packaging"
UNITS = ("plc-gateway@", "plc-gateway-bridge@", "plc-gateway-renew@", "plc-gateway-ca")
DOCKERFILE = ROOT / "Dockerfile"
WORST = 30  # tenths, of `systemd-analyze security`


def analyze(*arguments: object) -> "subprocess.CompletedProcess[str]":
    command = [needs("systemd-analyze"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.fixture(params=UNITS)
def unit(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """The unit of a gateway or bridge `hall`, with a program that is installed here."""
    own = (PACKAGING / f"systemd/{request.param}.service").read_text()
    text, count = re.subn(r"(?<=ExecStart=)/opt/\S+", "/bin/true", own)
    assert count == 1
    file = tmp_path / f"{request.param.replace('@', '@hall')}.service"
    file.write_text(text)
    return file


def test_systemd_accepts_the_unit(unit: Path) -> None:
    done = analyze("verify", "--man=no", unit)
    # Units that this machine has by itself may have faults of their own.
    about = [line for line in done.stderr.splitlines() if "plc-gateway" in line]
    assert about == []


def test_the_unit_gives_few_rights(unit: Path) -> None:
    done = analyze("security", "--offline=true", f"--threshold={WORST}", "--no-pager", unit)
    assert done.returncode == 0, done.stdout[-200:] + done.stderr


def test_systemd_makes_the_user_and_the_folder(tmp_path: Path) -> None:
    (tmp_path / "etc").mkdir()
    for kind in ("sysusers", "tmpfiles"):
        name = f"plc-gateway.{kind}.conf"
        folder = tmp_path / f"usr/lib/{kind}.d"
        folder.mkdir(parents=True)
        (folder / name).write_text((PACKAGING / "systemd" / name).read_text())
    command = [needs("systemd-sysusers"), f"--root={tmp_path}"]
    subprocess.run(command, check=True, capture_output=True)
    assert "plc-gateway:" in (tmp_path / "etc/passwd").read_text()
    assert re.search(
        r"^dialout:.*:plc-gateway$", (tmp_path / "etc/group").read_text(), re.MULTILINE
    )
    text = (PACKAGING / "systemd/plc-gateway.tmpfiles.conf").read_text()
    assert re.search(r"^d /etc/plc-gateway 0750 root plc-gateway -$", text, re.MULTILINE)


def test_the_dockerfile_has_no_known_mistake() -> None:
    done = subprocess.run(
        [needs("hadolint"), "--no-color", DOCKERFILE], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, "")


def test_the_container_writes_to_its_volume_only() -> None:
    text = DOCKERFILE.read_text()
    [state] = re.findall(r"STATE_DIRECTORY=(\S+)", text)
    assert f"VOLUME {state}\n" in text
    compose = yaml.safe_load((PACKAGING / "container/compose.yaml").read_text())
    for service in compose["services"].values():
        assert service["read_only"] is True
        assert service["cap_drop"] == ["ALL"]
    [*_, volume] = compose["services"]["gateway"]["volumes"]
    assert volume == f"data:{state}"
    load(PACKAGING / "container/plant.yaml")


def test_the_pod_writes_to_its_volume_only_and_is_probed(tmp_path: Path) -> None:
    text = (PACKAGING / "kubernetes/plc-gateway.yaml").read_text()
    config, workload = yaml.safe_load_all(text)
    file = tmp_path / "config.yaml"
    file.write_text(config["data"]["config.yaml"])
    loaded = load(file)
    pod = workload["spec"]["template"]["spec"]
    [container] = pod["containers"]
    assert container["securityContext"]["readOnlyRootFilesystem"] is True
    assert pod["securityContext"]["runAsUser"] == int(
        re.findall(r"^USER (\d+)", DOCKERFILE.read_text(), re.MULTILINE)[0]
    )
    assert {mount["mountPath"] for mount in container["volumeMounts"]} == {
        "/data",
        "/etc/plc-gateway",
    }
    for probe in ("startupProbe", "readinessProbe", "livenessProbe"):
        command = container[probe]["exec"]["command"]
        assert command == ["plc-gateway", "health", "/etc/plc-gateway/config.yaml"]
    # A probe that needs a router would restart the gateway when the router is away.
    assert loaded.zenoh.listen == ("tcp/127.0.0.1:7447",)
