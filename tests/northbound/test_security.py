"""Who may connect, read and write; what must stay secret; what strangers may throw at it."""

import asyncio
import hashlib
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import AbstractContextManager, asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

import pytest
import structlog
import zenoh

from gateway.cli.client.connection import PASSWORD_VARIABLE, USER_VARIABLE
from gateway.config import TlsConfig, ZenohConfig
from gateway.engine.requests import CommandResult
from gateway.errors import ConfigError
from gateway.northbound import Northbound, secrets
from gateway.northbound.audit import BURST, Audit
from gateway.northbound.payload import Failure, Problem, WriteOutcome
from gateway.northbound.rate_limit import RateLimit
from gateway.northbound.session import configure
from gateway.northbound.writers import NotAllowed, Writers
from gateway.tags import WriteResult
from tests.config.test_commands import Below
from tests.conftest import needs
from tests.e2e.processes import PATIENCE, Done, Program, started, vigor_line, write_config
from tests.northbound.test_northbound import PlainPlant, mixer, until
from tests.zenoh_peer import ZenohPeer, free_endpoint

PAGE = Path(__file__).parents[2] / "docs" / "security.md"
GATEWAY_RULES, ROUTER_RULES = re.findall(r"```json5\n(.*?)```", PAGE.read_text(), re.DOTALL)
PASSWORDS = {name: f"of-{name}-5f0c1" for name in ("gateway", "viewer", "operator", "health")}
RECIPE = "plant/mixer/recipe/@set"
TOKEN = "Zm9vYmFyYmF6cXV4Zm9vYmFyYmF6cXV4"  # noqa: S105  (of a test)
SALT = "0123456789abcdef"


def secret(path: Path, text: str) -> Path:
    path.write_text(text)
    path.chmod(0o600)
    return path


def writers_line(name: str, token: str) -> str:
    return f"{name}:{SALT}:{hashlib.sha256((SALT + token).encode()).hexdigest()}\n"


# -- Zenoh's access control as docs/security.md has it -----------------------------------------


def users(folder: Path) -> Path:
    return secret(folder / "users.txt", "".join(f"{n}:{p}\n" for n, p in PASSWORDS.items()))


def rules(text: str) -> Any:
    return json.loads(zenoh.Config.from_json5(text).get_json("access_control"))


def as_user(name: str, endpoint: str, password: str | None = None) -> ZenohPeer:
    own = {"user": name, "password": password or PASSWORDS[name]}
    config = {f"transport/auth/usrpwd/{key}": value for key, value in own.items()}
    return ZenohPeer("client", connect=[endpoint], config=config)


@asynccontextmanager
async def running(northbound: Northbound) -> AsyncIterator[None]:
    serves = asyncio.create_task(northbound.run())
    opens = asyncio.create_task(northbound.opened.wait())
    await asyncio.wait([serves, opens], return_when=asyncio.FIRST_COMPLETED, timeout=5)
    try:
        if serves.done():
            serves.result()
        yield
    finally:
        opens.cancel()
        serves.cancel()
        await asyncio.wait([serves], timeout=5)


COMMANDED = Below(CommandResult("acknowledged", 1, 0.1))


@asynccontextmanager
async def behind_a_router(plant: PlainPlant, folder: Path) -> AsyncIterator[tuple[Any, str]]:
    endpoint = free_endpoint()
    config = {
        "access_control": rules(ROUTER_RULES),
        "transport/auth/usrpwd/dictionary_file": str(users(folder)),
    }
    password = secret(folder / "password.txt", PASSWORDS["gateway"] + "\n")
    settings = ZenohConfig(connect=(endpoint,), user="gateway", password_file=password)
    async with ZenohPeer("router", listen=[endpoint], config=config):
        northbound = Northbound(settings, "demo", plant, commanded=COMMANDED)
        async with running(northbound):
            await until(lambda: northbound.counters()["links"] == 1)
            yield northbound, endpoint


@asynccontextmanager
async def by_itself(plant: PlainPlant, folder: Path) -> AsyncIterator[tuple[Any, str]]:
    endpoint = free_endpoint()
    file = folder / "access.json5"
    file.write_text(GATEWAY_RULES)
    settings = ZenohConfig(listen=(endpoint,), config_file=file, users_file=users(folder))
    northbound = Northbound(settings, "demo", plant, commanded=COMMANDED)
    async with running(northbound):
        yield northbound, endpoint


@pytest.mark.parametrize("guarded", [behind_a_router, by_itself])
async def test_a_viewer_reads_and_an_operator_writes_and_nobody_else_does(
    guarded: Callable[..., Any], tmp_path: Path
) -> None:
    plant = mixer(blocks=True)
    async with (
        guarded(plant, tmp_path) as (northbound, endpoint),
        as_user("viewer", endpoint) as viewer,
        as_user("operator", endpoint) as operator,
    ):
        live = await viewer.liveliness("plant/@gateway/*")
        await live.next(lambda token: token.key == "plant/@gateway/demo")
        for reader in (viewer, operator):
            heard = await reader.subscribe("plant/**")
            for _ in range(100):  # subscribing takes a moment that nothing tells the end of
                northbound.publish([plant.now("mixer/speed", 12)])
                if heard.samples:
                    break
                await asyncio.sleep(0.05)
            assert heard.samples
            for selector, count in (
                ("plant/**", 4),
                ("plant/**/@meta", 4),
                ("plant/*/@block", 1),
                ("plant/@gateway/demo/status", 1),
                ("plant/mixer/speed?max_age=1h", 1),
            ):
                assert len(await reader.get(selector, consolidation="NONE")) == count, selector
            late = await reader.subscribe("plant/**", advanced=True)
            await late.until(lambda of: len(of.latest()) == 4)
        audit = await viewer.subscribe("plant/@gateway/demo/writes")

        # The viewer, by every way there is.
        before = northbound.counters()["queries"]
        for key in (RECIPE, "plant/mixer/**/@set", "plant/**/@set", "plant/**", "**", "**/@set"):
            replies = await viewer.get(key, b"7", target="ALL")
            assert not any(reply.key == RECIPE[:-5] + "/@set" for reply in replies)
            await viewer.put(key, b"7")
            await viewer.delete(key)
        assert northbound.counters()["queries"] == before + 1  # `plant/**`, a question for values
        assert plant.written == []

        # The operator, by the one way that is allowed.
        [reply] = await operator.get(RECIPE, b"7")
        assert reply.ok
        await audit.next(lambda line: line.json["outcome"] == "written")
        for key in ("plant/mixer/**/@set", "plant/**/@set"):
            for reply in await operator.get(key, b"8"):
                assert reply.json["error"] == "unknown-tag"
        await operator.put(RECIPE, b"9")
        [reply] = await operator.get(RECIPE, b"10")  # after the put, on the same way
        assert reply.ok
        assert plant.written == [("mixer/recipe", 7), ("mixer/recipe", 10)]

        # Strangers.
        for stranger in (
            ZenohPeer("client", connect=[endpoint], config={"connect/timeout_ms": 500}),
            as_user("operator", endpoint, "wrong"),
        ):
            assert await refused(stranger)


@pytest.mark.parametrize("guarded", [behind_a_router, by_itself])
async def test_neither_a_viewer_nor_an_operator_commands_a_plc_or_all_of_a_line(
    guarded: Callable[..., Any], tmp_path: Path
) -> None:
    async with guarded(mixer(), tmp_path) as (_, endpoint):
        for name in ("viewer", "operator"):
            async with as_user(name, endpoint) as person:
                assert len(await person.get("plant/@gateway/demo/status")) == 1
                for key in ("plant/oven/@stop", "plant/@gateway/demo/lines/hall/global"):
                    assert await person.get(key, b"on", target="ALL") == []
    assert COMMANDED.told == []


async def refused(peer: ZenohPeer) -> bool:
    """Whether it cannot even connect."""
    peer._setup["config"]["connect/timeout_ms"] = 500
    try:
        async with peer:
            return False
    except ConnectionError:
        return True


# -- certificates ------------------------------------------------------------------------------


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


async def test_mutual_tls_lets_in_whom_the_authority_signed(tmp_path: Path) -> None:
    signed = certificates(tmp_path)
    certificate, key = signed("gateway")
    tls = TlsConfig(ca=tmp_path / "ca.pem", certificate=certificate, key=key, mutual=True)
    endpoint = free_endpoint().replace("tcp/", "tls/")
    plant = mixer()
    own_certificate, own_key = signed("operator")
    link = "transport/link/tls"
    anonymous = {f"{link}/root_ca_certificate": str(tmp_path / "ca.pem")}
    known = anonymous | {
        f"{link}/enable_mtls": True,
        f"{link}/connect_certificate": str(own_certificate),
        f"{link}/connect_private_key": str(own_key),
    }
    async with running(Northbound(ZenohConfig(listen=(endpoint,), tls=tls), "demo", plant)):
        async with ZenohPeer("client", connect=[endpoint], config=known) as client:
            [reply] = await client.get(RECIPE, b"7")
            assert reply.ok
        # Without a certificate the link is closed as soon as it is open.
        stranger = ZenohPeer("client", connect=[endpoint], config=anonymous)
        assert await refused(stranger)
    assert plant.written == [("mixer/recipe", 7)]


# -- the command line, where the doors are closed ----------------------------------------------

TAGS = {"speed": {"address": "D100"}, "recipe": {"address": "D500", "write": True}}


def typed(user: str | None, *arguments: object, password: str | None = None) -> Done:
    """`plc-gateway ...`, typed by somebody who says who he is, or by nobody. `watch` ends with
    whoever reads one line of it."""
    known = {}
    if user is not None:
        known = {USER_VARIABLE: user, PASSWORD_VARIABLE: password or PASSWORDS[user]}
    command = f"{sys.executable} -m gateway {' '.join(map(str, arguments))}"
    done = subprocess.run(
        ["sh", "-c", f"{command} | head -n 1" if arguments[0] == "watch" else command],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        env={**os.environ, **known},
        check=False,
    )
    assert "Traceback" not in done.stderr, done.stderr
    return Done(done.returncode, done.stdout, done.stderr)


def plant_file(folder: Path, **zenoh_settings: Any) -> Path:
    lines = {"hall": vigor_line("simulator", TAGS)}
    settings = {"prefix": "plant", **zenoh_settings}
    return write_config(folder / "plant.yaml", "", lines, zenoh=settings)


def tls_endpoint() -> str:
    return free_endpoint().replace("tcp/", "tls/")


@contextmanager
def closed_by_itself(folder: Path) -> Iterator[Path]:
    """As in docs/scada.md."""
    certificate, key = certificates(folder)("gateway")
    (folder / "access.json5").write_text(GATEWAY_RULES)
    path = plant_file(
        folder,
        listen=[tls_endpoint().replace("127.0.0.1", "0.0.0.0")],
        tls={"ca": "ca.pem", "certificate": certificate.name, "key": key.name},
        users_file=users(folder).name,
        config_file="access.json5",
    )
    with started(path) as program:
        program.says("device online")
        yield path


@contextmanager
def closed_by_a_router(folder: Path) -> Iterator[Path]:
    """A gateway in mode `router` stands for one: its rules are those of the page."""
    certificate, key = certificates(folder)("router")
    endpoint = tls_endpoint()
    tls = {"ca": "ca.pem", "certificate": certificate.name, "key": key.name}
    (folder / "access.json5").write_text(ROUTER_RULES)
    router = {
        "mode": "router",
        "prefix": "other",
        "listen": [endpoint],
        "tls": tls,
        "users_file": users(folder).name,
        "config_file": "access.json5",
    }
    lines = {"hall": vigor_line("simulator", {})}
    password = secret(folder / "password.txt", PASSWORDS["gateway"])
    path = plant_file(
        folder,
        listen=[],
        connect=[endpoint],
        tls={"ca": "ca.pem"},
        user="gateway",
        password_file=password.name,
    )
    with (
        started(write_config(folder / "router.yaml", "", lines, zenoh=router)),
        started(path) as it,
    ):
        it.says("device online")
        it.says("Zenoh link up")
        yield path


@pytest.mark.parametrize("closed", [closed_by_itself, closed_by_a_router])
def test_behind_closed_doors_the_command_line_may_what_its_user_may(
    closed: Callable[[Path], AbstractContextManager[Path]], tmp_path: Path
) -> None:
    with closed(tmp_path) as path:
        while typed("viewer", "read", path).code:
            pass  # the first values are on their way
        assert json.loads(typed("viewer", "watch", path, "--json").out)["quality"] == "good"
        assert typed("operator", "write", path, "mixer/recipe", "7").code == 0
        done = typed("operator", "read", path, "mixer/recipe", "--json", "--max-age", "0s")
        assert (done.code, json.loads(done.out)["value"]) == (0, 7)
        done = typed("viewer", "write", path, "mixer/recipe", "8")
        assert (done.code, done.out) == (1, "")
        assert "nothing was sent; may viewer do this, and does the gateway run" in done.err
        # Enough for a container, and no more.
        assert json.loads(typed("health", "health", path).out)["name"] == "demo"
        done = typed("health", "read", path)
        assert (done.code, done.out) == (1, "")
        assert "no reply: " in done.err
        assert "may health query it?" in done.err
        done = typed("operator", "read", path, password="wrong")  # noqa: S106  (it is none)
        assert (done.code, done.out) == (1, "")
        assert "refuses the user operator: the name or password is wrong" in done.err
        assert len(done.err.splitlines()) == 1


def test_without_a_name_the_command_line_is_told_how_to_say_one(tmp_path: Path) -> None:
    with closed_by_itself(tmp_path) as path:
        for command in ("read", "health"):
            done = typed(None, command, path)
            assert (done.code, done.out) == (1, "")
            assert "requires a name and password" in done.err
            assert f"set {USER_VARIABLE} and {PASSWORD_VARIABLE}" in done.err


def test_at_a_router_the_gateways_own_user_may_ask_whether_it_is_well_and_no_more(
    tmp_path: Path,
) -> None:
    with closed_by_a_router(tmp_path) as path:
        while (done := typed(None, "health", path)).code:
            pass  # the router learns of the gateway
        assert json.loads(done.out)["name"] == "demo"
        done = typed(None, "read", path)
        assert (done.code, done.out) == (1, "")
        assert "may gateway query it?" in done.err


def test_with_mutual_tls_the_command_line_shows_the_certificate_of_the_gateway(
    tmp_path: Path,
) -> None:
    certificate, key = certificates(tmp_path)("gateway")
    own = {"ca": "ca.pem", "certificate": certificate.name, "key": key.name, "mutual": True}
    path = plant_file(tmp_path, listen=[tls_endpoint()], tls=own)
    with started(path):
        assert typed(None, "health", path).code == 0


def test_without_mutual_tls_nobody_at_the_shell_needs_the_private_key(tmp_path: Path) -> None:
    with closed_by_itself(tmp_path) as path:
        (tmp_path / "gateway.key").write_text("not for the command line")
        assert typed("operator", "health", path).code == 0


def test_a_certificate_that_does_not_hold_the_address_is_named_as_the_reason(
    tmp_path: Path,
) -> None:
    certificate, key = certificates(tmp_path)("gateway", "DNS:gateway.plant")
    own = {"ca": "ca.pem", "certificate": certificate.name, "key": key.name}
    endpoint = tls_endpoint()
    path = plant_file(tmp_path, listen=[endpoint.replace("127.0.0.1", "0.0.0.0")], tls=own)
    with started(path):
        done = typed(None, "read", path)
    assert (done.code, done.out) == (1, "")
    assert done.err.startswith(f"{endpoint} has an untrusted certificate: ")
    assert "not valid for '127.0.0.1'" in done.err


@pytest.mark.parametrize("given", [USER_VARIABLE, PASSWORD_VARIABLE])
def test_a_name_without_a_password_is_a_mistake_and_so_is_the_reverse(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: str
) -> None:
    monkeypatch.setenv(given, "operator")
    done = typed(None, "read", plant_file(tmp_path, listen=[free_endpoint()]))
    assert (done.code, done.out) == (2, "")
    assert done.err == f"{USER_VARIABLE} and {PASSWORD_VARIABLE} belong together: set both\n"


# -- who wrote ---------------------------------------------------------------------------------


async def test_with_writers_only_a_token_writes_and_its_owner_is_named(tmp_path: Path) -> None:
    file = secret(tmp_path / "writers.txt", "# plant\n\n" + writers_line("alice", TOKEN))
    plant = mixer()
    endpoint = free_endpoint()
    recorded: list[WriteOutcome] = []
    northbound = Northbound(
        ZenohConfig(listen=(endpoint,)),
        "demo",
        plant,
        writers=file,
        record_write=recorded.append,
    )
    async with running(northbound), ZenohPeer("client", connect=[endpoint]) as client:
        audit = await client.subscribe("plant/@gateway/demo/writes")
        for token in (None, b"", b"short", TOKEN[:-1].encode(), b"\xff" * 40, b"x" * 5000):
            [reply] = await client.get(RECIPE, b"7", attachment=token)
            assert reply.json["error"] == "not-allowed"
            assert TOKEN[:-1] not in reply.payload.decode()
            await client.put(RECIPE, b"7", attachment=token)
        [reply] = await client.get(RECIPE, b"8", attachment=TOKEN.encode())
        assert reply.ok
        await client.put(RECIPE, b"9", attachment=TOKEN.encode())
        await audit.until(lambda of: len(of.samples) == 14)
        lines = [sample.json for sample in audit.samples]
        assert {line["outcome"] for line in lines[:12]} == {"not-allowed"}
        assert [(line["value"], line["by"]) for line in lines[12:]] == [(8, "alice"), (9, "alice")]
        assert plant.written == [("mixer/recipe", 8), ("mixer/recipe", 9)]
        assert [(done.by, type(done.result)) for done in recorded[12:]] == [
            ("alice", WriteResult)
        ] * 2
        assert len(recorded) == 14


def test_a_token_that_was_taken_back_or_a_file_that_was_opened_to_all_lets_nobody_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    file = secret(tmp_path / "writers.txt", writers_line("alice", TOKEN))
    writers = Writers(file)
    assert writers.owner(TOKEN.encode()) == "alice"
    file.write_text(writers_line("bob", TOKEN))
    assert writers.owner(TOKEN.encode()) == "alice"  # looked at within a second
    clock[0] += 2
    assert writers.owner(TOKEN.encode()) == "bob"
    file.chmod(0o644)
    clock[0] += 2
    with pytest.raises(NotAllowed):
        writers.owner(TOKEN.encode())
    file.chmod(0o600)
    clock[0] += 2
    assert writers.owner(TOKEN.encode()) == "bob"
    file.unlink()
    clock[0] += 2
    with pytest.raises(NotAllowed):
        writers.owner(TOKEN.encode())


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("alice:" + TOKEN, "line 1: write it as name:salt:hash"),
        ("alice:salt:zz", "line 1: write it as name:salt:hash"),
        (writers_line("alice", TOKEN) * 2, "line 2: alice is there twice"),
        ("".join(writers_line(f"w{n}", TOKEN) for n in range(101)), "more than 100"),
    ],
)
def test_a_bad_writers_file_is_a_configuration_error(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says) as raised:
        Writers(secret(tmp_path / "writers.txt", text))
    assert TOKEN not in str(raised.value)


def test_the_one_liner_of_the_page_makes_a_line_and_its_token(tmp_path: Path) -> None:
    (program,) = re.findall(r'^\$ python3 -c "(.*)"$', PAGE.read_text(), re.MULTILINE)
    out = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    token, line = out.stdout.splitlines()
    writers = Writers(secret(tmp_path / "writers.txt", line))
    assert writers.owner(token.removeprefix("token ").encode()) == "alice"


# -- the audit under a flood -------------------------------------------------------------------


def outcome(result: WriteResult | Failure, number: int = 0) -> WriteOutcome:
    return WriteOutcome("plant/mixer/recipe", number, result, number, 0.0, None)


def test_a_flood_of_refusals_is_counted_and_what_was_written_is_told_meanwhile() -> None:
    told: list[bytes] = []
    kept: list[WriteOutcome] = []
    audit = Audit(told.append, kept.append)
    with structlog.testing.capture_logs() as lines:
        for number in range(10_000):
            audit(outcome(Failure(Problem.UNKNOWN_TAG, "no"), number))
        for ending in (
            WriteResult(1, 0, took=0.1),
            Failure(Problem.UNCLEAR, "?"),
            Failure(Problem.REFUSED, "no", "28"),
        ):
            audit(outcome(ending))
        audit.tell_rest()
        audit.tell_rest()
    assert len(told) == len(kept) == BURST + 3
    assert [type(done.result) for done in kept[BURST:]] == [WriteResult, Failure, Failure]
    assert audit.untold == 10_000 - BURST
    assert len(lines) == BURST + 3 + 1
    assert lines[-1]["count"] == 10_000 - BURST


def test_a_limiter_lets_a_burst_through_and_then_one_now_and_again() -> None:
    limiter = RateLimit(burst=3, every=2.0)
    passed = [now for now in range(20) if limiter.allows(float(now) / 2)]
    assert passed == [0, 1, 2, 4, 8, 12, 16]
    assert limiter.untold() == limiter.held == 20 - len(passed)
    assert limiter.untold() == 0


# -- what must stay secret ---------------------------------------------------------------------


@pytest.mark.parametrize("setting", ["password_file", "users_file", "key", "config_file"])
def test_a_secret_that_everybody_can_read_is_refused(tmp_path: Path, setting: str) -> None:
    file = tmp_path / "secret"
    file.write_text('{transport: {auth: {usrpwd: {user: "a", password: "hunter2-x"}}}}')
    if setting == "key":
        settings = ZenohConfig(tls=TlsConfig(certificate=tmp_path / "c.pem", key=file))
    else:
        settings = ZenohConfig(**{setting: file, "user": "gateway"})  # type: ignore[arg-type]  # by name
    file.chmod(0o644)
    with pytest.raises(ConfigError, match="is open to everybody on this machine: run chmod") as one:
        configure(settings)
    assert "hunter2-x" not in str(one.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("viewer secret-x", "line 1: write it as name:password"),
        ("viewer:a\n# a note\noperator:secret-x", "line 2: write it as name:password"),
        ("viewer:\n", "line 1: write it as name:password"),
        (":secret-x\n", "line 1: write it as name:password"),
        ("", "names nobody, and would let everybody in"),
        ("\n \n", "names nobody, and would let everybody in"),
    ],
)
def test_a_users_file_that_says_not_who_may_connect_is_refused(
    tmp_path: Path, text: str, says: str
) -> None:
    with pytest.raises(ConfigError, match=says) as raised:
        configure(ZenohConfig(users_file=secret(tmp_path / "users.txt", text)))
    assert "secret-x" not in str(raised.value)


def test_what_is_no_certificate_or_key_is_named(tmp_path: Path) -> None:
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
def test_nothing_is_quoted_from_a_zenoh_file_that_may_hold_a_password(
    tmp_path: Path, text: str
) -> None:
    with pytest.raises(ConfigError, match="it may hold a password") as raised:
        configure(ZenohConfig(config_file=secret(tmp_path / "zenoh.json5", text)))
    assert "hunter2-x" not in str(raised.value)


async def test_nothing_the_gateway_prints_or_serves_holds_a_secret(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    zenoh_file = secret(
        tmp_path / "zenoh.json5",
        '{transport: {auth: {usrpwd: {user: "gateway", password: "in-the-zenoh-file"}}}}',
    )
    everybody = users(tmp_path)
    everybody.write_text(everybody.read_text() + "gateway2:in-the-users-file\n")
    hash_of = writers_line("alice", TOKEN)
    config = {
        "gateway": {"name": "demo"},
        "zenoh": {
            "listen": [endpoint],
            "config_file": str(zenoh_file),
            "user": "gateway2",
            "password_file": str(secret(tmp_path / "password", "in-the-password-file")),
            "users_file": str(everybody),
        },
        "writers": {"file": str(secret(tmp_path / "writers", hash_of))},
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
            heard = await client.subscribe("plant/@gateway/**")
            for token in (None, b"wrong-token-of-somebody", TOKEN.encode()):
                served += [r.payload for r in await client.get(RECIPE, b"7", attachment=token)]
            for selector in ("plant/**", "plant/**/@meta", "plant/@gateway/**"):
                served += [r.payload for r in await client.get(selector, consolidation="NONE")]
            await heard.next(lambda sample: sample.json.get("by") == "alice")
            served += [sample.payload for sample in heard.samples]
        with ZenohRefused(endpoint):
            pass
        assert await asyncio.to_thread(program.end) == 0
    shown = "\n".join(program.lines) + "\n".join(data.decode() for data in served)
    assert "written" in shown
    assert len(served) > 8
    for word in (
        *PASSWORDS.values(),
        "in-the-zenoh-file",
        "in-the-users-file",
        "in-the-password-file",
        "wrong-token-of-somebody",
        TOKEN,
        SALT,
        hash_of.rpartition(":")[2].strip(),
    ):
        assert word not in shown, word


class ZenohRefused:
    """A connection attempt with a wrong password, for what the gateway may say of it."""

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


# -- who could reach it ------------------------------------------------------------------------


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
        ("tls/0.0.0.0:7447", {}, ["nothing protects it"]),  # encrypted, and open to everybody
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
def test_what_others_can_reach_unprotected_is_told(
    listen: str, setup: dict[str, Any], says: list[str]
) -> None:
    config = configure(ZenohConfig())
    for path, value in {"listen/endpoints": [listen], **setup}.items():
        config.insert_json5(path, json.dumps(value))
    told = secrets.exposures(config)
    assert len(told) == len(says)
    for sentence, words in zip(told, says, strict=True):
        assert words in sentence
        assert listen in sentence
