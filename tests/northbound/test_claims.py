"""The rules by which gateways under one prefix share out the devices."""

from collections.abc import Iterable

from hypothesis import given
from hypothesis import strategies as st

from gateway.northbound.group.claims import LAST_TICKET, MOST_OTHERS, RETURN_TIME, Claim, Claims


def gateway(session: str, devices: Iterable[str] = ("mixer", "oven"), **group: str) -> Claims:
    return Claims(session, f"gateway-{session}", group.get("group"), devices)


def test_a_device_that_another_gateway_claimed_is_taken() -> None:
    first, second = gateway("1"), gateway("2", ["mixer", "press"])
    second.found(first.claim(1000, ()))
    assert second.taken() == {"mixer": "gateway-1"}
    assert second.changed({}, 0.0)
    second.claim(1001, ["mixer"])
    assert second.own is not None
    assert second.own.devices == {"press"}
    assert not second.changed({"mixer": "gateway-1"}, 0.0)
    first.found(second.own)
    assert first.taken() == {}


def test_of_two_gateways_with_one_name_the_second_must_end() -> None:
    first, second = Claims("1", "demo", None, ["mixer"]), Claims("2", "demo", None, ["press"])
    assert not first.namesake()
    second.found(first.claim(1000, ()))
    assert second.namesake()
    first.found(second.claim(1001, ()))
    assert (first.namesake(), second.namesake()) == (False, True)
    second.lost("1")
    assert not second.namesake()
    first.found(gateway("3").claim(1, ()))
    assert not first.namesake()


def test_a_clock_that_is_behind_does_not_displace_the_first_gateway() -> None:
    first, second = gateway("2"), gateway("1")
    second.found(first.claim(1_000_000, ()))
    first.found(second.claim(5, ()))
    assert first.taken() == {}
    assert second.taken().keys() == {"mixer", "oven"}


@given(st.integers(0, 3), st.integers(0, 3))
def test_of_two_that_did_not_see_each_other_exactly_one_keeps_the_device(a: int, b: int) -> None:
    first, second = gateway("1"), gateway("2")
    claims = first.claim(a, ()), second.claim(b, ())
    first.found(claims[1])
    second.found(claims[0])
    assert (first.taken() == {}) != (second.taken() == {})
    assert (first.taken() == {}) == (a <= b)  # the smaller session of equal tickets


def test_a_device_returns_when_its_gateway_has_been_gone_for_some_time() -> None:
    first, second = gateway("1"), gateway("2")
    claim = first.claim(1, ())
    second.found(claim)
    withheld = second.taken()
    second.lost("1")
    assert not second.changed(withheld, 0.0)
    second.found(claim)  # it had only restarted
    assert not second.changed(withheld, RETURN_TIME)
    second.lost("1")
    assert not second.changed(withheld, RETURN_TIME + 1)
    assert second.changed(withheld, 2 * RETURN_TIME + 1)


def test_members_of_one_standby_group_do_not_take_devices_from_each_other() -> None:
    active = gateway("1", group="hall").claim(1, ())
    for group, taken in (("hall", False), ("yard", True)):
        other = gateway("2", group=group)
        other.found(active)
        assert bool(other.taken()) is taken
    alone = gateway("3")
    alone.found(active)
    assert alone.taken()


def test_the_own_claim_takes_nothing() -> None:
    own = gateway("1")
    own.found(Claim(0, "1", "other", None, frozenset({"mixer"})))
    assert own.taken() == {}


def test_the_last_ticket_of_another_keeps_nobody_from_claiming() -> None:
    first, second = gateway("2"), gateway("1", ["press"])
    first.found(Claim(LAST_TICKET, "0", "other", None, frozenset({"lamp"})))
    second.found(first.claim(1000, ()))
    assert first.own is not None
    assert first.own.ticket == LAST_TICKET
    assert second.claim(1000, ()).ticket == LAST_TICKET


def test_claims_without_an_end_take_no_memory_and_hide_no_known_gateway() -> None:
    first, second = gateway("s"), gateway("t")
    second.found(first.claim(1000, ()))
    for number in range(2 * MOST_OTHERS):
        second.found(Claim(1, f"forged-{number}", "forged", None, frozenset({"lamp"})))
    assert second.taken(["lamp"]) == {"lamp": "forged"}
    assert second.taken().keys() == {"mixer", "oven"}
    second.lost("s")
    assert second.taken() == {}
