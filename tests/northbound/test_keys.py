"""The keys of the contract, and the keys that arrive."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.contract.keys import Family, Keys, ParsedKey, max_age, parse_key
from gateway.errors import BadValue, ConfigError

KEYS = Keys("site/plant", "hall-1")
CHUNK = st.from_regex(r"[\w.\-]{1,12}", fullmatch=True)
TAG = st.lists(CHUNK, min_size=2, max_size=5).map("/".join)


def test_the_keys_of_the_contract() -> None:
    assert KEYS.value("mixer/alarms/door") == "site/plant/mixer/alarms/door"
    assert KEYS.set("mixer/recipe") == "site/plant/mixer/recipe/@set"
    assert KEYS.meta("mixer/recipe") == "site/plant/mixer/recipe/@meta"
    assert KEYS.block("mixer") == "site/plant/mixer/@block"
    assert KEYS.device("mixer") == "site/plant/mixer"
    assert KEYS.own == "site/plant/@gateway/hall-1"
    assert KEYS.alive("mixer") == "site/plant/@gateway/hall-1/alive/mixer"
    assert KEYS.status("lines/hall-1") == "site/plant/@gateway/hall-1/lines/hall-1"
    assert KEYS.writes == "site/plant/@gateway/hall-1/writes"


@pytest.mark.parametrize(
    ("key", "family", "target"),
    [
        ("plant/mixer/speed", Family.VALUE, "plant/mixer/speed"),
        ("plant/**", Family.VALUE, "plant/**"),
        ("plant/mixer/recipe/@set", Family.SET, "plant/mixer/recipe"),
        ("plant/**/@set", Family.SET, "plant/**"),
        ("**/@meta", Family.META, "**"),
        ("plant/*/@block", Family.BLOCK, "plant/*"),
        ("plant/@gateway/*/status", Family.STATUS, "plant/@gateway/*/status"),
        ("plant/**/@adv/**", Family.LAST, "plant/**"),
        ("plant/mixer/speed/@adv/**", Family.LAST, "plant/mixer/speed"),
    ],
)
def test_a_received_key_has_a_family_and_a_target(key: str, family: Family, target: str) -> None:
    assert parse_key(key) == ParsedKey(family, target)


@pytest.mark.parametrize("key", ["plant/*/speed", "plant/**", "plant/mix$*/speed/@set"])
def test_a_wildcard_of_any_kind_is_recognised(key: str) -> None:
    assert parse_key(key).has_wildcard
    assert not parse_key("plant/mixer/speed").has_wildcard


@given(TAG)
@settings(max_examples=50)
def test_every_tag_comes_back_from_each_of_its_keys(tag: str) -> None:
    assert KEYS.tag(KEYS.value(tag)) == tag
    for key, family in (
        (KEYS.value(tag), Family.VALUE),
        (KEYS.set(tag), Family.SET),
        (KEYS.meta(tag), Family.META),
    ):
        assert parse_key(key).family is family
        assert KEYS.tag(parse_key(key).target) == tag


@given(st.text(alphabet="ab/@*$set_metablockgwy", max_size=40))
@settings(max_examples=200)
def test_any_key_is_parsed(key: str) -> None:
    assert len(parse_key(key).target) <= len(key)


def test_a_key_outside_the_prefix_is_no_tag() -> None:
    assert KEYS.tag("site/plantation/mixer/speed") is None
    assert KEYS.tag("site/plant") is None


@pytest.mark.parametrize(
    ("prefix", "reason"),
    [
        ("", "one `/` separates"),
        ("/plant", "one `/` separates"),
        ("plant/", "one `/` separates"),
        ("a//b", "one `/` separates"),
        ("@plant", "reserved"),
        ("pl*nt", "wildcard"),
        ("a#", "wildcard"),
        ("a b", "has a space: names are letters and digits"),
        ("a:b", "has ':': names are letters and digits"),
    ],
)
def test_a_prefix_that_is_no_key_is_refused_with_the_reason(prefix: str, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        Keys(prefix, "demo")


def test_a_gateways_name_is_one_chunk() -> None:
    with pytest.raises(ConfigError, match="the gateway's name 'a/b'"):
        Keys("plant", "a/b")
    assert Keys("工場/площадка", "größe-1").own == "工場/площадка/@gateway/größe-1"


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("0s", 0.0), ("0", 0.0), ("500ms", 0.5), ("2s", 2.0), ("1.5s", 1.5), ("15min", 900.0)],
)
def test_an_age_is_written_like_every_duration(text: str, seconds: float) -> None:
    assert max_age(text) == seconds


@pytest.mark.parametrize("text", ["", "s", "-1s", "1 x", "nan", "inf", "1e3s", "9" * 400, "1s\n"])
def test_an_age_that_is_no_duration_is_refused(text: str) -> None:
    with pytest.raises(BadValue, match="no duration"):
        max_age(text)
