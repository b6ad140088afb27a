"""The security pages as their tests use them: settings, commands and sentences out of the page."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import zenoh

from tests.e2e.processes import ROOT, Program, free_port, gateway, vigor_line
from tests.zenoh_peer import ZenohPeer

PAGES = {
    name: (ROOT / name).read_text("utf-8")
    for name in ("SECURITY.md", "docs/security.md", "docs/access-control.md")
}
SECURITY, RULES = PAGES["docs/security.md"], PAGES["docs/access-control.md"]
_FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


class Unit(NamedTuple):
    """A paragraph, bullet, row of a table, or program of a page. White space is one space."""

    section: str
    text: str


def block(section: str, language: str, number: int = 0, page: str = SECURITY) -> str:
    """Returns a program of a section. `language`: as at its fence."""
    found = [text for known, text in _FENCE.findall(_section(section, page)) if known == language]
    return str(found[number])


def table(section: str, page: str = SECURITY) -> list[list[str]]:
    """Returns the cells of the rows of a section's table, without its head."""
    rows = re.findall(r"^\|(.*)\|$", _section(section, page), re.MULTILINE)
    return [[cell.strip() for cell in row.split("|")] for row in rows[2:]]


def quoted(text: str, page: str = SECURITY) -> str:
    """Returns a text that the page has: the test does what it says. Fails if it has it not."""
    assert text in _one_line(page), text
    return text


def units(page: str) -> Iterator[Unit]:
    """Yields everything that a page says, but its titles, the heads of tables and programs."""
    for part in re.split(r"^(?=#)", page, flags=re.MULTILINE):
        title, _, body = part.partition("\n")
        body = _FENCE.sub("", body)
        body = re.sub(r"^\|.*\n\|-.*\n", "\n", body, flags=re.MULTILINE)
        for text in re.split(r"\n\n+|\n(?=\* |\|)", body):
            if one := _one_line(text.removeprefix("* ")):
                yield Unit(title.lstrip("# "), one)


def _section(title: str, page: str) -> str:
    return re.split(r"^#+ ", page.partition(f"# {title}\n")[2], flags=re.MULTILINE)[0]


def _one_line(text: str) -> str:
    return " ".join(text.split())


# -- plants with the settings of a page --------------------------------------------------------

TAGS = {
    "speed": {"address": "D100", "alarm": {"high": 0}},  # it is always reached
    "recipe": {"address": "D500", "write": {"min": 1, "max": 40}},
}
OVEN = {
    "protocol": "computer-link",
    "station": 5,
    "reply_timeout": "2s",  # also for a machine that stands still for a moment
    "blocks": True,
    "tags": {"dial": {"address": "D0100", "write": True}},
}
VALUES = 3  # in all


def plant_file(
    folder: Path, page_text: str, port: int | None = None, *, control: bool = False, **sections: Any
) -> Path:
    """Writes `plant.yaml` with a text of the page. `port`: instead of the one of the page.

    `control`: the oven takes commands.
    """
    lines = {
        "hall": vigor_line("simulator", TAGS, reply_timeout="2s"),
        "annex": {"port": "simulator", "devices": {"oven": OVEN | {"control": control}}},
    }
    rest = {"gateway": {"name": "demo"}, "lines": lines, "defaults": {"every": "200ms"}}
    text = page_text.replace("7447", str(port or free_port()))
    ours = "".join(f"{key}: {json.dumps(value)}\n" for key, value in (rest | sections).items())
    path = folder / "plant.yaml"
    path.write_text(text + ours)
    return path


def serving(path: Path, **environment: str) -> Program:
    """Starts a gateway and waits for its first values."""
    variables = [f"{name}={value}" for name, value in environment.items()]
    program = gateway("run", path, variables=variables)
    try:
        program.says("Zenoh session ready")
        program.says("device online", "mixer")
        program.says("device online", "oven")
    except BaseException:
        program.__exit__()
        raise
    return program


# -- clients -----------------------------------------------------------------------------------


def tls_of(folder: Path, name: str | None = None) -> dict[str, Any]:
    """Zenoh's settings for the authority of a folder, and the certificate of this name."""
    link = "transport/link/tls"
    found: dict[str, Any] = {f"{link}/root_ca_certificate": str(folder / "ca.pem")}
    if name is not None:
        found[f"{link}/enable_mtls"] = True
        found[f"{link}/connect_certificate"] = str(folder / f"{name}.pem")
        found[f"{link}/connect_private_key"] = str(folder / f"{name}.key")
    return found


def user_of(name: str, password: str) -> dict[str, Any]:
    own = {"user": name, "password": password}
    return {f"transport/auth/usrpwd/{key}": value for key, value in own.items()}


def client(endpoint: str, *settings: dict[str, Any]) -> ZenohPeer:
    config = {key: value for each in settings for key, value in each.items()}
    return ZenohPeer("client", connect=[endpoint], config=config)


def refusal(endpoint: str, *settings: dict[str, Any]) -> str:
    """Returns Zenoh's words for a refused connection, "" for an accepted one."""
    config = zenoh.Config()
    given = {key: value for each in settings for key, value in each.items()}
    for path, value in {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": 500,
        "scouting/multicast/enabled": False,
        **given,
    }.items():
        config.insert_json5(path, json.dumps(value))
    try:
        zenoh.open(config).close()  # type: ignore[no-untyped-call]  # Zenoh's stub lacks it
    except zenoh.ZError as error:
        return str(error).partition(" at ")[0]
    return ""
