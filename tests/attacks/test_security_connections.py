"""docs/security.md, the default and restricted connections: each rule, with its attacker."""

import asyncio
import json
import shutil
import socket
import sys
from pathlib import Path
from typing import Any

import pytest

from gateway.cli.client import connected
from gateway.config import load
from gateway.errors import GatewayError
from tests.attacks.security_pages import (
    VALUES,
    block,
    client,
    plant_file,
    quoted,
    refusal,
    serving,
    tls_of,
    user_of,
)
from tests.e2e.processes import Program, free_port
from tests.northbound.access import GATEWAY_RULES, PASSWORDS, certificates, secret, users
from tests.zenoh_peer import Reply, ZenohPeer

RECIPE = "plant/mixer/recipe/@set"
TLS, PASSWORD = (block("Restrict connections", "yaml", number) for number in (0, 1))


async def writes(client: ZenohPeer, value: int = 7) -> Reply:
    [reply] = await client.get(RECIPE, b"%d" % value)
    return reply


async def test_by_default_programs_of_this_machine_read_and_write_and_no_others(
    tmp_path: Path,
) -> None:
    quoted("listens on this machine only (`tcp/127.0.0.1:7447`), and every program")
    default = plant_file(tmp_path, "")
    [endpoint] = load(default).zenoh.listen
    assert endpoint == "tcp/127.0.0.1:7447"
    port = free_port()
    path = plant_file(tmp_path, f"zenoh: {{listen: [{endpoint}]}}\n", port)
    with await asyncio.to_thread(serving, path) as program:
        assert not program.has_said("Zenoh session exposed")
        with socket.socket() as other:  # as from another machine
            assert other.connect_ex(("127.0.0.2", port)) != 0
        async with client(f"tcp/127.0.0.1:{port}") as any_program:
            [value] = await any_program.get("plant/mixer/recipe?max_age=0s")
            assert value.json["quality"] == "good"
            outcomes = await any_program.subscribe("plant/@gateway/demo/writes")
            assert (await writes(any_program)).ok
            written = await outcomes.next(lambda sample: sample.json["outcome"] == "written")
            assert written.json["by"] is None  # this client tells Zenoh no id of its own
            # SECURITY.md: write only where the file says so, and within its limits.
            assert (await writes(any_program, 41)).json["error"] == "bad-value"
            [refused] = await any_program.get("plant/mixer/speed/@set", b"7")
            assert refused.json["error"] == "not-writable"
            [refused] = await any_program.get("plant/oven/@stop")
            assert refused.json["error"] == "not-writable"


async def test_a_gateway_that_others_reach_without_protection_warns(tmp_path: Path) -> None:
    port = free_port()
    warning = block("The default", "text").strip().replace("7447", str(port))
    path = plant_file(tmp_path, "zenoh: {listen: [tcp/0.0.0.0:7447]}\n", port)
    with await asyncio.to_thread(serving, path) as program:
        assert program.has_said("Zenoh session exposed", warning)


async def test_with_mutual_true_every_client_needs_a_certificate_of_the_authority(
    tmp_path: Path,
) -> None:
    """Rules can name the common names of certificates; the command line has the gateway's own."""
    quoted("they use the gateway's own certificate. Rules with `cert_common_names` give them")
    signed, forger = certificates(tmp_path), tmp_path / "forger"
    forger.mkdir()
    for name in ("gateway", "viewer", "operator", "stranger"):
        signed(name)
    certificates(forger)("operator")
    stolen_name = tls_of(forger, "operator") | tls_of(tmp_path)
    rules = GATEWAY_RULES.replace("usernames: [", 'cert_common_names: ["gateway", ', 1)
    (tmp_path / "access.json5").write_text(rules.replace("usernames:", "cert_common_names:"))
    port = free_port()
    here = f"127.0.0.1:{port}"
    path = plant_file(tmp_path, TLS + "  config_file: access.json5\n", port)
    with await asyncio.to_thread(serving, path) as program:
        assert not program.has_said("Zenoh session exposed")
        for attacker in (tls_of(tmp_path), stolen_name):
            assert await asyncio.to_thread(refusal, f"tls/{here}", attacker)
        assert await asyncio.to_thread(refusal, f"tcp/{here}")
        for name, reads, may_write in (
            ("operator", VALUES, 1),
            ("viewer", VALUES, 0),
            ("stranger", 0, 0),
        ):
            async with client(f"tls/{here}", tls_of(tmp_path, name)) as person:
                assert len(await person.get("plant/**")) == reads, name
                assert len(await person.get(RECIPE, b"7")) == may_write, name
        await asyncio.to_thread(reads_and_does_not_write, path)
    # Without it, the certificate only proves the identity of the gateway.
    assert "mutual: true" in TLS
    path = plant_file(tmp_path, TLS.replace(", mutual: true", ""), port)
    with await asyncio.to_thread(serving, path) as program:
        assert program.has_said("Zenoh session exposed", "nothing protects it")
        deceived = await asyncio.to_thread(refusal, f"tls/{here}", tls_of(forger))
        assert deceived  # a gateway with this certificate is not the one of the other authority
        async with client(f"tls/{here}", tls_of(tmp_path)) as anyone:
            assert (await writes(anyone)).ok


def reads_and_does_not_write(path: Path) -> None:
    """The client of the command line."""
    with connected(load(path), print) as own:
        assert len(own.values("**")) == VALUES
        with pytest.raises(GatewayError, match="nothing was sent"):
            own.requests.write("mixer/recipe", 8)


async def test_by_name_and_password(tmp_path: Path) -> None:
    """The whole example of the page, with a router that demands a user too."""
    signed = certificates(tmp_path)
    names = quoted("`subjectAltName = DNS:gateway.plant, IP:127.0.0.1`").split(" = ")[1].strip("`")
    signed("gateway", names.replace(" ", ""))
    signed("router")
    for file in (users(tmp_path), secret(tmp_path / "password.txt", PASSWORDS["gateway"] + "\n")):
        file.chmod(0o640)  # as the page says
    (tmp_path / "gateway.key").chmod(0o640)
    port, far = free_port(), free_port()
    link = "transport/link/tls"
    router = ZenohPeer(
        "router",
        listen=[f"tls/127.0.0.1:{far}"],
        config={
            f"{link}/listen_certificate": str(tmp_path / "router.pem"),
            f"{link}/listen_private_key": str(tmp_path / "router.key"),
            "transport/auth/usrpwd/dictionary_file": str(tmp_path / "users.txt"),
        },
    )
    text = PASSWORD.replace("tls/router.plant:7447", f"tls/127.0.0.1:{far}")
    near, trust = f"tls/127.0.0.1:{port}", tls_of(tmp_path)
    operator = user_of("operator", PASSWORDS["operator"])
    async with router:
        with await asyncio.to_thread(serving, plant_file(tmp_path, text, port)) as program:
            assert not program.has_said("Zenoh session exposed")
            await asyncio.to_thread(program.says, "Zenoh link up", "to=router")
            for endpoint in (near, f"tls/127.0.0.1:{far}"):
                async with client(endpoint, trust, operator) as person:
                    await person.until_alive("plant/@gateway/*", ["plant/@gateway/demo"])
                    assert (await writes(person)).ok
                attackers: tuple[dict[str, Any], ...] = (
                    user_of("mallory", PASSWORDS["operator"]),
                    user_of("operator", PASSWORDS["viewer"]),
                    {},
                )
                words = {
                    await asyncio.to_thread(refusal, endpoint, trust, who) for who in attackers
                }
                assert len(words) == 1  # all are refused in the same way
                assert all(words)


async def test_the_password_of_the_variable_and_the_warning_of_an_open_link(
    tmp_path: Path,
) -> None:
    users(tmp_path)
    port, far = free_port(), free_port()
    text = PASSWORD.replace("tls/router.plant:7447", f"tcp/127.0.0.1:{far}")
    text = text.replace("tls/0.0.0.0", "tcp/0.0.0.0")
    kept = [line for line in text.splitlines() if not line.strip().startswith(("tls:", "passw"))]
    path = plant_file(tmp_path, "\n".join(kept) + "\n", port)
    dictionary = {"transport/auth/usrpwd/dictionary_file": str(tmp_path / "users.txt")}
    variable = quoted("the variable PLC_GATEWAY_ZENOH_PASSWORD").split()[-1]
    async with ZenohPeer("router", listen=[f"tcp/127.0.0.1:{far}"], config=dictionary):
        own = {variable: PASSWORDS["gateway"]}
        with await asyncio.to_thread(serving, path, **own) as program:
            await asyncio.to_thread(program.says, "Zenoh link up", "to=router")
            assert program.has_said("passwords and values travel in the clear")
            assert await asyncio.to_thread(refusal, f"tcp/127.0.0.1:{port}")


HIDDEN = "hunter2-in-this-file"
# Runs `plc-gateway run` with each file, in a process of its own that need not load the program.
RUN_EACH = """
import os, sys
from gateway.cli.main import main
for path in sys.argv[1:]:
    if (child := os.fork()) == 0:
        sys.argv = ["plc-gateway", "run", path]
        main()
    print("ended with", os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


def test_files_with_secrets_are_closed_and_hold_users_or_the_gateway_does_not_start(
    tmp_path: Path,
) -> None:
    """Each mistake in a folder of its own. No message shows what the file contains."""
    quoted("`gateway.secret_file`, `web.tokens_file`, and a `config_file` that contains")
    password = json.dumps({"transport": {"auth": {"usrpwd": {"user": "a", "password": HIDDEN}}}})
    line = f"viewer:{HIDDEN}\n"
    open_files = {
        "gateway.key": HIDDEN,
        "password.txt": HIDDEN,
        "users.txt": line,
        "writers.txt": line,
        "plant.txt": HIDDEN,
        "zenoh.json5": password,
    }
    mistakes: list[tuple[str, str, int, str]] = [
        *((name, text, 0o644, "is open to every user") for name, text in open_files.items()),
        ("plant.txt", HIDDEN[:19], 0o640, "its first line has fewer than 20 characters"),
        ("users.txt", "\n", 0o640, "would accept every connection"),
        ("users.txt", line + f"operator {HIDDEN}\n", 0o640, "line 2: write it as name:password"),
        ("zenoh.json5", password[:-1], 0o640, "it may hold a password, so no more is shown"),
        ("plant.yaml", f"password: {HIDDEN}", 0o644, "zenoh.password"),
        ("plant.yaml", f"tls: {{key_text: {HIDDEN}}}", 0o644, "zenoh.tls.key_text"),
    ]

    (tmp_path / "right").mkdir()
    certificates(tmp_path / "right")("gateway")

    def written(number: int) -> Path:
        name, text, mode, _ = mistakes[number]
        folder = shutil.copytree(tmp_path / "right", tmp_path / str(number))
        users(folder)
        secret(folder / "password.txt", "of-the-gateway")
        secret(folder / "writers.txt", f"alice:{'s' * 40}\n")
        secret(folder / "plant.txt", "s" * 20)
        (folder / "zenoh.json5").write_text("{}")
        page = PASSWORD.replace("router.plant", "127.0.0.1") + "  config_file: zenoh.json5\n"
        if name == "plant.yaml":
            page += f"  {text}\n" if "tls" not in text else ""
            page = page.replace("tls: {", text.removesuffix("}") + ", ") if "tls" in text else page
        else:
            (folder / name).write_text(text)
            (folder / name).chmod(mode)
        own = {"name": "demo", "secret_file": "plant.txt"}
        return plant_file(folder, page, writers={"file": "writers.txt"}, gateway=own)

    paths = [written(number) for number in range(len(mistakes))]
    with Program(sys.executable, "-c", RUN_EACH, *paths) as program:
        assert program.ended() == 0
    ends = [number for number, line in enumerate(program.lines) if line.startswith("ended with")]
    assert len(ends) == len(mistakes)
    for (name, _, _, words), begin, end in zip(mistakes, [-1, *ends], ends, strict=False):
        said = "\n".join(program.lines[begin + 1 : end])
        assert program.lines[end] == "ended with 2", (name, said)
        assert words in said, (name, said)
        assert name in said or name == "plant.yaml", said
        assert HIDDEN[:19] not in said, (name, said)
