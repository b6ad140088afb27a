"""The election in a plant of gateways and one router: ordinary failures in any order."""

import random
from collections import deque
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.northbound.group.election import (
    CLAIM_TIME,
    SETTLE_TIME,
    Election,
    Role,
    RoleToken,
    State,
)

STEP = 0.05
LONGEST_TRAVEL = 0.3  # seconds a token travels at most
SLOWEST_LINK = 5.0  # seconds until every gateway is linked again after a router came back
FLAP = 0.9  # seconds until a connection that was cut once is up again


class Node:
    """A gateway in the world. `dice` decides how long everything takes."""

    def __init__(self, name: str, dice: random.Random) -> None:
        self.name = name
        self.dice = dice
        self.lives = 0
        self.election: Election | None = None
        self.linked = False
        self.links_at: float | None = None  # when it is linked again
        self.inbox: deque[tuple[float, Callable[[Election, float], None]]] = deque()

    @property
    def tokens(self) -> set[RoleToken]:
        roles = {State.CLAIMING: {Role.CLAIM}, State.ACTIVE: {Role.CLAIM, Role.ACTIVE}}
        if self.election is None:
            return set()
        session = self.election.session
        return {RoleToken(r, self.name, session) for r in roles.get(self.election.state, ())}

    def post(self, now: float, action: Callable[[Election, float], None]) -> None:
        """Delivers the action a little later, in the order of posting."""
        at = now + self.dice.uniform(0.0, LONGEST_TRAVEL)
        if self.inbox:
            at = max(at, self.inbox[-1][0])
        self.inbox.append((at, action))


class World:
    def __init__(self, count: int, dice: random.Random) -> None:
        self.now = 0.0
        self.dice = dice
        self.router = True
        self.nodes = [Node(chr(ord("a") + n), dice) for n in range(count)]
        self.visible: dict[str, set[RoleToken]] = {node.name: set() for node in self.nodes}

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP)):
            self.now += STEP
            for node in self.nodes:
                self._step(node)
            self._spread()
            active = [n.name for n in self.nodes if state_of(n) is State.ACTIVE]
            assert len(active) <= 1, f"{active} at {self.now:.2f} s"
            assert all(state_of(node) is not State.REPLACED for node in self.nodes)

    def _step(self, node: Node) -> None:
        if node.election is None:
            return
        if node.links_at is not None and self.router and self.now >= node.links_at:
            node.links_at, node.linked = None, True
            node.post(self.now, _router_link(up=True))
        while node.inbox and node.inbox[0][0] <= self.now:
            node.inbox.popleft()[1](node.election, self.now)
        node.election.decide(self.now)

    def _spread(self) -> None:
        """The router forwards the tokens of every linked node to all others."""
        for node in self.nodes:
            there = set()
            if node.linked:
                there = {s for o in self.nodes if o is not node and o.linked for s in o.tokens}
            for token in self.visible[node.name] ^ there:
                node.post(self.now, _token_changed(token, token in there))
            self.visible[node.name] = there

    def cut(self, node: Node, back_after: float) -> None:
        if node.linked:
            node.linked = False
            node.post(self.now, _router_link(up=False))
        node.links_at = self.now + back_after

    def _link_time(self) -> float:
        """Often the shortest and the longest possible time."""
        return self.dice.choice([0.0, SLOWEST_LINK, self.dice.uniform(0.0, SLOWEST_LINK)])

    # What happens

    def start(self, node: Node) -> None:
        if node.election is None:
            node.lives += 1
            session = f"{self.dice.random()}"
            node.election = Election(node.name, session, self.now, needs_link=True)
            node.links_at = self.now + self._link_time()

    def crash(self, node: Node) -> None:
        node.election, node.linked, node.links_at = None, False, None
        node.inbox.clear()
        self.visible[node.name] = set()

    def flap(self, node: Node) -> None:
        if node.election is not None and node.linked:
            self.cut(node, self.dice.uniform(0.1, FLAP - STEP))

    def router_down(self, _: Node) -> None:
        self.router = False
        for node in self.nodes:
            if node.election is not None:
                self.cut(node, float("inf"))

    def router_restart(self, node: Node) -> None:
        self.router_down(node)
        self.router_up(node)

    def router_up(self, _: Node) -> None:
        if not self.router:
            self.router = True
            for node in self.nodes:
                if node.election is not None:
                    node.links_at = self.now + self._link_time()


def _router_link(*, up: bool) -> Callable[[Election, float], None]:
    return lambda election, now: election.link_changed("router", up, True, now)


def _token_changed(token: RoleToken, present: bool) -> Callable[[Election, float], None]:
    return lambda election, now: election.token_changed(token, present)


def state_of(node: Node) -> State | None:
    return None if node.election is None else node.election.state


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


@settings(max_examples=120)
@given(
    count=st.integers(2, 3),
    seed=st.integers(0, 2**32),
    events=EVENTS,
    settled=st.sampled_from([20.0, 0.0]),
)
def test_ordinary_failures_in_any_order_never_make_two_active(
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
    # Afterwards exactly one is active soon after the network works again.
    world.router_up(world.nodes[0])
    world.start(world.nodes[1])
    world.run(SLOWEST_LINK + SETTLE_TIME + 3 * CLAIM_TIME)
    assert sum(state_of(node) is State.ACTIVE for node in world.nodes) == 1


def test_a_lasting_split_makes_both_active() -> None:
    """The limit that docs/standby.md describes."""
    world = World(2, random.Random(1))
    for node in world.nodes:
        world.start(node)
    world.run(SLOWEST_LINK + SETTLE_TIME + 3 * CLAIM_TIME)
    (active,) = (node for node in world.nodes if state_of(node) is State.ACTIVE)
    world.cut(active, 5.0)
    with pytest.raises(AssertionError, match=r"\['a', 'b'\]"):
        world.run(5.0)
