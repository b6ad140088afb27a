"""The rules of the election in a standby group."""

import pytest

from gateway.northbound.group.election import (
    CLAIM_TIME,
    LONGEST_PAUSE,
    MOST_TOKENS,
    QUERY_VALIDITY,
    SETTLE_TIME,
    Election,
    Role,
    RoleToken,
    State,
)

STEP = 0.05


def alone(now: float = 0.0, **settings: float | None) -> Election:
    return Election("a", "s1", now, needs_link=False, **settings)


def until(election: Election, state: State, now: float, latest: float) -> float:
    """Runs the clock until the state is reached; returns the time."""
    while now < latest:
        if election.decide(now) is state:
            return now
        now += STEP
    raise AssertionError(f"still {election.state} after {latest} s")


def test_the_only_gateway_is_active_after_settle_and_claim_time() -> None:
    now = until(alone(), State.ACTIVE, 0.0, 20.0)
    assert SETTLE_TIME + CLAIM_TIME <= now < SETTLE_TIME + CLAIM_TIME + 3 * STEP


def test_after_a_crash_of_the_active_gateway_another_is_active_within_three_seconds() -> None:
    election = alone()
    other = RoleToken(Role.ACTIVE, "b", "s2")
    election.token_changed(other, True)
    for step in range(int(60 / STEP)):
        assert election.decide(step * STEP) is State.STANDBY
    election.token_changed(other, False)
    assert until(election, State.ACTIVE, 60.0, 63.0) < 62.0


def test_of_two_that_start_together_the_first_by_name_is_active() -> None:
    first, second = (Election(n, s, 0.0, needs_link=False) for n, s in (("a", "9"), ("b", "1")))
    for step in range(int(20 / STEP)):
        for one, other in ((first, second), (second, first)):
            one.decide(step * STEP)
            present = one.state is State.CLAIMING
            other.token_changed(RoleToken(Role.CLAIM, one.name, one.session), present)
            present = one.state is State.ACTIVE
            other.token_changed(RoleToken(Role.ACTIVE, one.name, one.session), present)
    assert (first.state, second.state) == (State.ACTIVE, State.STANDBY)


@pytest.mark.parametrize(("name", "state"), [("0", State.REPLACED), ("b", State.ACTIVE)])
def test_when_a_split_heals_the_first_by_name_stays_active(name: str, state: State) -> None:
    election = alone()
    now = until(election, State.ACTIVE, 0.0, 20.0)
    election.token_changed(RoleToken(Role.ACTIVE, name, "s2"), True)
    assert election.decide(now + STEP) is state


def test_a_paused_active_gateway_is_replaced() -> None:
    election = alone()
    now = until(election, State.ACTIVE, 0.0, 20.0)
    assert election.decide(now + LONGEST_PAUSE + STEP) is State.REPLACED


def test_a_paused_claiming_gateway_claims_again() -> None:
    election = alone()
    now = until(election, State.CLAIMING, 0.0, 20.0) + LONGEST_PAUSE + STEP
    assert election.decide(now) is State.CLAIMING
    assert until(election, State.ACTIVE, now, now + 3.0) >= now + CLAIM_TIME


def test_a_token_found_by_a_query_counts_for_a_limited_time() -> None:
    election = alone()
    other = RoleToken(Role.ACTIVE, "b", "s2")
    now = until(election, State.CLAIMING, 0.0, 20.0)
    election.token_found(other, now)
    assert election.needs_query
    assert election.decide(now + STEP) is State.STANDBY
    assert until(election, State.CLAIMING, now + STEP, now + 2.0) > now + QUERY_VALIDITY


def test_own_tokens_are_ignored_but_those_of_an_earlier_session_count() -> None:
    election = alone()
    election.token_changed(RoleToken(Role.ACTIVE, "a", "s1"), True)
    assert election.others(Role.ACTIVE) == []
    election.token_changed(RoleToken(Role.ACTIVE, "a", "s0"), True)
    assert election.others(Role.ACTIVE) == ["a"]


def test_a_waiting_gateway_is_seen_and_decides_nothing() -> None:
    election, waiting = alone(), RoleToken(Role.WAITING, "0", "s0")
    election.token_changed(waiting, True)
    until(election, State.ACTIVE, 0.0, 20.0)
    assert election.others(Role.WAITING) == ["0"]
    election.token_changed(waiting, False)
    assert election.others(Role.WAITING) == []


def test_without_a_needed_link_it_waits_for_ever() -> None:
    election = Election("a", "s1", 0.0, needs_link=True)
    with pytest.raises(AssertionError, match="still waiting"):
        until(election, State.CLAIMING, 0.0, 120.0)
    assert election.waits_for_link


def test_without_a_needed_link_it_claims_after_the_time_in_alone() -> None:
    election = Election("a", "s1", 0.0, needs_link=True, alone=30.0)
    assert 30.0 <= until(election, State.CLAIMING, 0.0, 120.0) < 31.0


def test_without_a_router_the_link_of_the_other_may_end_with_it() -> None:
    election = Election("a", "s1", 0.0, needs_link=True)
    other = RoleToken(Role.ACTIVE, "b", "s2")
    election.link_changed("s2", up=True, router=False, now=0.0)
    election.token_changed(other, True)
    for step in range(int(60 / STEP)):
        election.decide(step * STEP)
    election.token_changed(other, False)
    election.link_changed("s2", up=False, router=False, now=60.0)
    assert until(election, State.ACTIVE, 60.0, 63.0) < 62.0


def test_clients_that_come_and_go_do_not_delay_a_claim() -> None:
    election = Election("a", "s1", 0.0, needs_link=True)
    election.link_changed("router", up=True, router=True, now=0.0)
    for step in range(int((SETTLE_TIME + CLAIM_TIME + 1) / STEP)):
        election.link_changed("client", up=step % 2 == 0, router=False, now=step * STEP)
        election.decide(step * STEP)
    assert election.state is State.ACTIVE


def test_a_router_that_visits_does_not_delay_a_gateway_that_sees_the_active_one_directly() -> None:
    election = alone()
    other = RoleToken(Role.ACTIVE, "b", "s2")
    election.link_changed("s2", up=True, router=False, now=0.0)
    election.token_changed(other, True)
    election.decide(1.0)
    election.link_changed("visitor", up=True, router=True, now=2.0)
    election.decide(3.0)
    election.link_changed("visitor", up=False, router=True, now=4.0)
    for step in range(int(4.0 / STEP), int(5.0 / STEP)):
        election.decide(step * STEP)
    election.token_changed(other, False)
    election.link_changed("s2", up=False, router=False, now=5.0)
    assert until(election, State.ACTIVE, 5.0, 8.0) < 7.0


def test_a_gateway_that_saw_the_active_one_through_a_router_waits_for_a_router() -> None:
    election = alone()
    other = RoleToken(Role.ACTIVE, "b", "s2")
    election.link_changed("router", up=True, router=True, now=0.0)
    election.token_changed(other, True)
    election.decide(1.0)
    election.token_changed(other, False)
    election.link_changed("router", up=False, router=True, now=2.0)
    with pytest.raises(AssertionError, match="still waiting"):
        until(election, State.CLAIMING, 2.0, 60.0)


def test_tokens_without_an_end_hide_no_active_gateway_that_was_seen_before() -> None:
    election, other = alone(), RoleToken(Role.ACTIVE, "b", "s2")
    election.token_changed(other, True)
    for number in range(2 * MOST_TOKENS):
        election.token_changed(RoleToken(Role.CLAIM, "z", str(number)), True)
        election.token_found(RoleToken(Role.CLAIM, "z", str(number)), 0.0)
    assert election.decide(30.0) is State.STANDBY
    for number in range(2 * MOST_TOKENS):
        election.token_changed(RoleToken(Role.CLAIM, "z", str(number)), False)
    election.token_changed(other, False)
    until(election, State.ACTIVE, 30.0, 33.0)
