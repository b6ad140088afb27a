"""Users, passwords, certificates and rules, as docs/security.md describes them."""

import json
import re
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zenoh

from tests.conftest import needs
from tests.zenoh_peer import ZenohPeer

PAGE = Path(__file__).parents[2] / "docs" / "security.md"


GATEWAY_RULES, ROUTER_RULES = re.findall(r"```json5\n(.*?)```", PAGE.read_text(), re.DOTALL)


PASSWORDS = {name: f"of-{name}-5f0c1" for name in ("gateway", "viewer", "operator", "health")}


def secret(path: Path, text: str) -> Path:
    path.write_text(text)
    path.chmod(0o600)
    return path


def users(folder: Path) -> Path:
    return secret(folder / "users.txt", "".join(f"{n}:{p}\n" for n, p in PASSWORDS.items()))


def rules(text: str) -> Any:
    return json.loads(zenoh.Config.from_json5(text).get_json("access_control"))


def as_user(name: str, endpoint: str, password: str | None = None) -> ZenohPeer:
    own = {"user": name, "password": password or PASSWORDS[name]}
    config = {f"transport/auth/usrpwd/{key}": value for key, value in own.items()}
    return ZenohPeer("client", connect=[endpoint], config=config)


def certificates(folder: Path) -> Callable[..., tuple[Path, Path]]:
    """An authority `ca.pem`, and what signs certificates with it: name -> certificate, key.

    A second argument is what the certificate is valid for, instead of this machine.
    """
    openssl = needs("openssl")

    def run(*arguments: object) -> None:
        command = [openssl, *map(str, arguments)]
        subprocess.run(command, check=True, capture_output=True, cwd=folder)

    made = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", "2"]
    run("req", "-x509", *made, "-keyout", "ca.key", "-out", "ca.pem", "-subj", "/CN=plant")

    def signed(name: str, names: str = "DNS:localhost,IP:127.0.0.1") -> tuple[Path, Path]:
        certificate, key = folder / f"{name}.pem", folder / f"{name}.key"
        (folder / "san").write_text(f"subjectAltName={names}\n")
        made_one = [*made[:-2], "-keyout", key, "-out", f"{name}.csr", "-subj", f"/CN={name}"]
        run("req", *made_one)
        run("x509", "-req", "-in", f"{name}.csr", "-CA", "ca.pem", "-CAkey", "ca.key",
            "-CAcreateserial", "-days", "2", "-extfile", "san", "-out", certificate)  # fmt: skip
        key.chmod(0o600)
        return certificate, key

    return signed
