"""A plain file is read as a stream, with the same data as by its tree."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from gateway.config import ConfigErrors, load
from gateway.config.yaml import file as yaml_file
from gateway.config.yaml.events import plain_data
from gateway.config.yaml.file import read_yaml

TEXTS = frozenset({"address", "name"})
PLANT = """\
lines:
  hall:
    port: simulator
    devices:
      plc: {protocol: vigor, station: 1, tags: {a: {address: D1}, b: {address: D2}}}
"""
names = st.sampled_from(["a", "b", "address", "name", "1", "yes", "x y"])
scalars = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-5, 70_000),
    st.floats(allow_nan=False),
    st.text(max_size=8),
    st.sampled_from(["7E1", "1e3", "010", "0x1F", "yes", "null", "~", ".inf", "40101", "<<"]),
)
data = st.dictionaries(
    names,
    st.recursive(
        scalars,
        lambda inner: st.one_of(
            st.lists(inner, max_size=3), st.dictionaries(names, inner, max_size=3)
        ),
        max_leaves=12,
    ),
    max_size=4,
)


@pytest.fixture
def composed(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    """The sizes of all files of which a tree was made."""
    sizes: list[int] = []
    compose = yaml.compose

    def counted(text: bytes, **named: Any) -> Any:
        sizes.append(len(text))
        return compose(text, **named)

    with monkeypatch.context() as patch:
        patch.setattr(yaml, "compose", counted)
        yield sizes


def by_tree(folder: Path, text: str) -> Any:
    path = folder / "t.yaml"
    path.write_text(text, newline="")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(yaml_file, "plain_data", lambda *_: None)
        return read_yaml(path, TEXTS)[0].data


@given(data, st.sampled_from([None, False, True]), st.booleans())
def test_the_data_is_that_of_the_tree(
    tmp_path_factory: pytest.TempPathFactory, tree: Any, flow: bool | None, ascii_only: bool
) -> None:
    text = yaml.safe_dump(tree, default_flow_style=flow, allow_unicode=not ascii_only)
    found = plain_data(text.encode(), TEXTS)
    if found is not None:
        # As texts: 1, 1.0 and true are equal, but not the same settings.
        assert repr(found) == repr(by_tree(tmp_path_factory.getbasetemp(), text))
    elif "<<" not in text:
        assert tree == {} or "&" in text or "!" in text, text


@pytest.mark.parametrize(
    "text",
    [
        "",
        "- a",
        "text",
        "a: &x 1\nb: *x",
        "a: !!int 1",
        "a: ! 1",
        "a: 1\na: 2",
        "<<: {b: 1}",
        "? [1]\n: 2",
        "a: {b: 1",
        "a: 1\n---\nb: 2",
        "a: \x01",
        "a: " + "[" * 60 + "]" * 60,
    ],
)
def test_any_other_file_is_left_to_the_tree(text: str) -> None:
    assert plain_data(text.encode(), TEXTS) is None


def test_a_plain_file_needs_no_tree(tmp_path: Path, composed: list[int]) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(PLANT)
    assert len(load(path).devices[0].tags) == 2
    assert composed == []


def test_a_mistake_is_found_with_its_line_all_the_same(tmp_path: Path, composed: list[int]) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(PLANT.replace("D2", "Q2"))
    with pytest.raises(ConfigErrors, match=r"c\.yaml:5: lines\.hall\.devices\.plc\.tags\.b"):
        load(path)
    assert len(composed) == 1


def test_the_share_that_is_read_grows_to_the_end(tmp_path: Path) -> None:
    text = "lines:\n" + "".join(f"  l{n}: {{devices: {{a: {{b: 1}}}}}}\n" for n in range(50))
    shares: list[float] = []
    plain_data(text.encode(), TEXTS, shares.append)
    assert shares == sorted(shares)
    assert shares[0] < 0.1 < 0.9 < shares[-1] <= 1
