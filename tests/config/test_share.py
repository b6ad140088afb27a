"""Shares of a file: each line in one of them, and what needs each other together."""

from pathlib import Path

import pytest

from gateway.config import Config, load
from gateway.config.settings.zenoh_records import ZenohMode
from gateway.config.share import parse_share
from gateway.errors import ConfigError
from tests.e2e.processes import PATIENCE, gateway, plc_gateway
from tests.zenoh_peer import free_endpoint

LINES = """\
gateway: {name: hall}
zenoh: {listen: [tcp/0.0.0.0:7447]}
web: {listen: 127.0.0.1:8080}
lines:
"""


def plant(folder: Path, *lines: str, head: str = LINES) -> Path:
    path = folder / "plant.yaml"
    path.write_text(head + "".join(f"  {line}\n" for line in lines))
    return path


def line(name: str, tags: str = "{a: {address: D1}}") -> str:
    device = f"{{protocol: vigor, station: 1, tags: {tags}}}"
    return f"{name}: {{port: simulator, devices: {{{name}: {device}}}}}"


def shares(path: Path, of: int) -> list[Config]:
    return [load(path, share=(number, of)) for number in range(1, of + 1)]


def names(config: Config) -> list[str]:
    return [one.name for one in config.lines]


def test_each_line_is_in_one_share_by_what_it_reads(tmp_path: Path) -> None:
    many = "{a: {address: 'D1', every: 100ms}, b: {address: D2}}"
    path = plant(tmp_path, line("l1", many), line("l2"), line("l3"), line("l4"))
    one, two = shares(path, 2)
    assert (names(one), names(two)) == (["l1"], ["l2", "l3", "l4"])


def test_the_first_share_is_the_router_of_the_others_and_has_the_page(tmp_path: Path) -> None:
    one, two = shares(plant(tmp_path, line("l1"), line("l2")), 2)
    assert (one.name, one.zenoh.mode, one.zenoh.listen) == (
        "hall",
        ZenohMode.ROUTER,
        ("tcp/0.0.0.0:7447",),
    )
    assert (two.name, two.zenoh.mode, two.zenoh.listen) == ("hall-2", ZenohMode.CLIENT, ())
    assert two.zenoh.connect == ("tcp/127.0.0.1:7447",)
    assert ("web" in one.parts, "web" in two.parts) == (True, False)
    assert (one.folder, two.folder) == (tmp_path, tmp_path / "share-2")


def test_with_a_router_in_the_file_all_shares_are_its_clients(tmp_path: Path) -> None:
    head = (
        "gateway: {name: hall}\nzenoh: {mode: client, listen: [], connect: [tcp/r:7447]}\nlines:\n"
    )
    one, two = shares(plant(tmp_path, line("l1"), line("l2"), head=head), 2)
    assert one.zenoh == two.zenoh
    assert one.zenoh.connect == ("tcp/r:7447",)


def test_lines_that_need_each_other_are_in_one_share(tmp_path: Path) -> None:
    sums = "{a: {address: D1}, s: {computed: \"'l1/a' + 1\"}}"
    path = plant(tmp_path, line("l1"), line("l2"), line("l3", sums))
    assert sorted(map(sorted, map(names, shares(path, 2)))) == [["l1", "l3"], ["l2"]]
    with pytest.raises(ConfigError, match="the lines make 2 shares at most: 3 were asked for"):
        load(path, share=(1, 3))


def test_a_line_that_is_added_at_the_end_moves_no_other(tmp_path: Path) -> None:
    before = shares(plant(tmp_path, *map(line, ("l1", "l2", "l3"))), 2)
    after = shares(plant(tmp_path, *map(line, ("l1", "l2", "l3", "l4"))), 2)
    assert all({*names(a)} <= {*names(b)} for a, b in zip(before, after, strict=True))


@pytest.mark.parametrize("text", ["", "2", "0/2", "3/2", "1/65", "a/b", "-1/2", "1/2/3"])
def test_other_words_are_no_share(text: str) -> None:
    with pytest.raises(ConfigError, match="write for example 2/3"):
        parse_share(text)


def test_an_absolute_path_is_refused(tmp_path: Path) -> None:
    head = f"gateway: {{name: hall}}\nhistory: {{path: {tmp_path}/h.db}}\nlines:\n"
    path = plant(tmp_path, line("l1"), line("l2"), head=head)
    with pytest.raises(ConfigError, match=r"h\.db: shares need a relative path"):
        load(path, share=(2, 2))


def test_two_processes_serve_one_file(tmp_path: Path) -> None:
    head = f"gateway: {{name: hall}}\nzenoh: {{listen: [{free_endpoint()}]}}\nlines:\n"
    path = plant(tmp_path, line("l1"), line("l2"), head=head)
    with (
        gateway("run", path, "--share", "1/2") as one,
        gateway("run", path, "--share", "2/2") as two,
    ):
        for program in (one, two):
            program.says("Zenoh session ready")
            program.says("device online")
        read = plc_gateway("read", path, "l1/a", "l2/a", "--max-age", f"{PATIENCE:.0f}s")
        assert read.code == 0, read
        assert read.out.count("good") == 2
        assert (one.end(), two.end()) == (0, 0)
    assert (tmp_path / "share-2").is_dir()
