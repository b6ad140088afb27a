"""Who may speak, as a group of gateways decides it: every order of ordinary failures."""

import random
from collections import deque
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.northbound.election import CLAIM, FROZEN, GLIMPSE, HOLD, Role, Sign, Stand, Standby

STEP = 0.05
LATEST = 0.3  # seconds a sign travels at most
SLOWEST_LINK = 5.0  # seconds until everybody is linked again after a router came back
FLAP = 0.9  # seconds that a connection cut once takes to be there again


def alone(now: float = 0.0, **settings: float | None) -> Standby:
    return Standby("a", "s1", now, needs_link=False, **settings)  # type: ignore[arg-type]  # one kind


def until(standby: Standby, stand: Stand, now: float, latest: float) -> float:
    """Runs the clock until it stands so; the time then."""
    while now < latest:
        if standby.decide(now) is stand:
            return now
        now += STEP
    raise AssertionError(f"still {standby.stand} after {latest} s")


def test_the_only_gateway_goes_on_the_wire_after_hold_and_claim() -> None:
    now = until(alone(), Stand.ACTIVE, 0.0, 20.0)
    assert HOLD + CLAIM <= now < HOLD + CLAIM + 3 * STEP


def test_a_crash_of_the_active_one_is_made_good_within_three_seconds() -> None:
    standby = alone()
    other = Sign(Role.ACTIVE, "b", "s2")
    standby.heard(other, True)
    for step in range(int(60 / STEP)):
        assert standby.decide(step * STEP) is Stand.WAITING
    standby.heard(other, False)
    assert until(standby, Stand.ACTIVE, 60.0, 63.0) < 62.0


def test_of_two_that_start_at_once_the_first_by_name_goes() -> None:
    first, second = (Standby(n, s, 0.0, needs_link=False) for n, s in (("a", "9"), ("b", "1")))
    for step in range(int(20 / STEP)):
        for one, other in ((first, second), (second, first)):
            one.decide(step * STEP)
            shown = one.stand is Stand.CLAIMING
            other.heard(Sign(Role.CLAIM, one.name, one.session), shown)
            shown = one.stand is Stand.ACTIVE
            other.heard(Sign(Role.ACTIVE, one.name, one.session), shown)
    assert (first.stand, second.stand) == (Stand.ACTIVE, Stand.WAITING)


@pytest.mark.parametrize(("name", "stand"), [("0", Stand.RELIEVED), ("b", Stand.ACTIVE)])
def test_when_a_split_heals_the_first_by_name_stays(name: str, stand: Stand) -> None:
    standby = alone()
    now = until(standby, Stand.ACTIVE, 0.0, 20.0)
    standby.heard(Sign(Role.ACTIVE, name, "s2"), True)
    assert standby.decide(now + STEP) is stand


def test_one_that_was_held_still_leaves_the_wire() -> None:
    standby = alone()
    now = until(standby, Stand.ACTIVE, 0.0, 20.0)
    assert standby.decide(now + FROZEN + STEP) is Stand.RELIEVED


def test_one_that_was_held_still_claims_anew() -> None:
    standby = alone()
    now = until(standby, Stand.CLAIMING, 0.0, 20.0) + FROZEN + STEP
    assert standby.decide(now) is Stand.CLAIMING
    assert until(standby, Stand.ACTIVE, now, now + 3.0) >= now + CLAIM


def test_what_was_only_glimpsed_counts_and_wears_off() -> None:
    standby = alone()
    other = Sign(Role.ACTIVE, "b", "s2")
    now = until(standby, Stand.CLAIMING, 0.0, 20.0)
    standby.glimpsed(other, now)
    assert standby.is_looking
    assert standby.decide(now + STEP) is Stand.WAITING
    assert until(standby, Stand.CLAIMING, now + STEP, now + 2.0) > now + GLIMPSE


def test_its_own_signs_mean_nothing_to_it_but_those_of_an_earlier_life_do() -> None:
    standby = alone()
    standby.heard(Sign(Role.ACTIVE, "a", "s1"), True)
    assert standby.others() == []
    standby.heard(Sign(Role.ACTIVE, "a", "s0"), True)
    assert standby.others() == ["a"]


def test_without_the_link_it_needs_it_waits_for_ever() -> None:
    standby = Standby("a", "s1", 0.0, needs_link=True)
    with pytest.raises(AssertionError, match="still waiting"):
        until(standby, Stand.CLAIMING, 0.0, 120.0)
    assert standby.is_blind


def test_without_the_link_it_needs_it_goes_when_it_was_told_to() -> None:
    standby = Standby("a", "s1", 0.0, needs_link=True, alone=30.0)
    assert 30.0 <= until(standby, Stand.CLAIMING, 0.0, 120.0) < 31.0


def test_the_others_own_link_may_go_with_it_where_there_is_no_router() -> None:
    standby = Standby("a", "s1", 0.0, needs_link=True)
    other = Sign(Role.ACTIVE, "b", "s2")
    standby.link("s2", up=True, router=False, now=0.0)
    standby.heard(other, True)
    for step in range(int(60 / STEP)):
        standby.decide(step * STEP)
    standby.heard(other, False)
    standby.link("s2", up=False, router=False, now=60.0)
    assert until(standby, Stand.ACTIVE, 60.0, 63.0) < 62.0


def test_clients_that_come_and_go_do_not_hold_up_a_claim() -> None:
    standby = Standby("a", "s1", 0.0, needs_link=True)
    standby.link("router", up=True, router=True, now=0.0)
    for step in range(int((HOLD + CLAIM + 1) / STEP)):
        standby.link("client", up=step % 2 == 0, router=False, now=step * STEP)
        standby.decide(step * STEP)
    assert standby.stand is Stand.ACTIVE


# -- a plant of gateways and one router --------------------------------------------------------


class Node:
    """A gateway as the others see it. `dice` decides how long everything takes."""

    def __init__(self, name: str, dice: random.Random) -> None:
        self.name = name
        self.dice = dice
        self.lives = 0
        self.standby: Standby | None = None
        self.linked = False
        self.links_at: float | None = None  # when its connection is there again
        self.inbox: deque[tuple[float, Callable[[Standby, float], None]]] = deque()

    @property
    def signs(self) -> set[Sign]:
        roles = {Stand.CLAIMING: {Role.CLAIM}, Stand.ACTIVE: {Role.CLAIM, Role.ACTIVE}}
        if self.standby is None:
            return set()
        session = self.standby.session
        return {Sign(r, self.name, session) for r in roles.get(self.standby.stand, ())}

    def post(self, now: float, what: Callable[[Standby, float], None]) -> None:
        """Arrives a little later, and never before what was posted earlier."""
        at = now + self.dice.uniform(0.0, LATEST)
        if self.inbox:
            at = max(at, self.inbox[-1][0])
        self.inbox.append((at, what))


class World:
    def __init__(self, count: int, dice: random.Random) -> None:
        self.now = 0.0
        self.dice = dice
        self.router = True
        self.nodes = [Node(chr(ord("a") + n), dice) for n in range(count)]
        self.told: dict[str, set[Sign]] = {node.name: set() for node in self.nodes}

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP)):
            self.now += STEP
            for node in self.nodes:
                self._step(node)
            self._spread()
            on_the_wire = [n.name for n in self.nodes if stands(n) is Stand.ACTIVE]
            assert len(on_the_wire) <= 1, f"{on_the_wire} at {self.now:.2f} s"
            assert all(stands(node) is not Stand.RELIEVED for node in self.nodes)

    def _step(self, node: Node) -> None:
        if node.standby is None:
            return
        if node.links_at is not None and self.router and self.now >= node.links_at:
            node.links_at, node.linked = None, True
            node.post(self.now, lambda s, now: s.link("router", True, True, now))
        while node.inbox and node.inbox[0][0] <= self.now:
            node.inbox.popleft()[1](node.standby, self.now)
        node.standby.decide(self.now)

    def _spread(self) -> None:
        """The router tells every linked node of the signs of all the others."""
        for node in self.nodes:
            there = set()
            if node.linked:
                there = {s for o in self.nodes if o is not node and o.linked for s in o.signs}
            for sign in self.told[node.name] ^ there:
                shown = sign in there
                node.post(self.now, lambda s, now, sign=sign, shown=shown: s.heard(sign, shown))
            self.told[node.name] = there

    def _cut(self, node: Node, back_after: float) -> None:
        if node.linked:
            node.linked = False
            node.post(self.now, lambda s, now: s.link("router", False, True, now))
        node.links_at = self.now + back_after

    def _link_time(self) -> float:
        """Often the least and the most there can be."""
        return self.dice.choice([0.0, SLOWEST_LINK, self.dice.uniform(0.0, SLOWEST_LINK)])

    # What happens

    def start(self, node: Node) -> None:
        if node.standby is None:
            node.lives += 1
            session = f"{self.dice.random()}"
            node.standby = Standby(node.name, session, self.now, needs_link=True)
            node.links_at = self.now + self._link_time()

    def crash(self, node: Node) -> None:
        node.standby, node.linked, node.links_at = None, False, None
        node.inbox.clear()
        self.told[node.name] = set()

    def flap(self, node: Node) -> None:
        if node.standby is not None and node.linked:
            self._cut(node, self.dice.uniform(0.1, FLAP - STEP))

    def router_down(self, _: Node) -> None:
        self.router = False
        for node in self.nodes:
            if node.standby is not None:
                self._cut(node, float("inf"))

    def router_restart(self, node: Node) -> None:
        self.router_down(node)
        self.router_up(node)

    def router_up(self, _: Node) -> None:
        if not self.router:
            self.router = True
            for node in self.nodes:
                if node.standby is not None:
                    node.links_at = self.now + self._link_time()


def stands(node: Node) -> Stand | None:
    return None if node.standby is None else node.standby.stand


EVENTS = st.lists(
    st.tuples(
        st.sampled_from(
            [
                World.start,
                World.crash,
                World.flap,
                World.router_down,
                World.router_up,
                World.router_restart,
            ]
        ),
        st.integers(0, 2),
        st.sampled_from([0.0, 0.2, 0.7, 1.6, 2.5, 6.0, 13.0]),
    ),
    min_size=5,
    max_size=12,
)


@settings(max_examples=120, deadline=None)
@given(
    count=st.integers(2, 3),
    seed=st.integers(0, 2**32),
    events=EVENTS,
    settled=st.sampled_from([20.0, 0.0]),
)
def test_ordinary_failures_in_any_order_never_put_two_on_the_wire(
    count: int,
    seed: int,
    events: list[tuple[Callable[[World, Node], None], int, float]],
    settled: float,
) -> None:
    world = World(count, random.Random(seed))
    for node in world.nodes[:2]:
        world.start(node)
    world.run(settled)
    for happens, number, then in events:
        happens(world, world.nodes[number % count])
        world.run(then)
    # And then, whatever has happened: exactly one serves soon after all is well again.
    world.router_up(world.nodes[0])
    world.start(world.nodes[1])
    world.run(SLOWEST_LINK + HOLD + 3 * CLAIM)
    assert sum(stands(node) is Stand.ACTIVE for node in world.nodes) == 1


def test_a_split_that_lasts_puts_both_on_the_wire() -> None:
    """What docs/standby.md says of it: this is where it stops being able to help."""
    world = World(2, random.Random(1))
    for node in world.nodes:
        world.start(node)
    world.run(SLOWEST_LINK + HOLD + 3 * CLAIM)
    (active,) = (node for node in world.nodes if stands(node) is Stand.ACTIVE)
    world._cut(active, 5.0)
    with pytest.raises(AssertionError, match=r"\['a', 'b'\]"):
        world.run(5.0)
