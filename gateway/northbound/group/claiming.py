"""Claims the devices of this gateway on Zenoh, and observes the claims of others.

A claim is a document below the gateway's status keys, and a liveliness token on the same key.
`claims` has the rules.
"""

import asyncio
import time
from collections.abc import Callable, Iterable, Mapping
from itertools import islice

import structlog
import zenoh

from gateway.contract.documents.state import ClaimDocument
from gateway.contract.keys import Keys
from gateway.northbound.group.claim_documents import ClaimDocuments
from gateway.northbound.group.claims import MOST_OTHERS, Claims
from gateway.northbound.group.plant_secret import PlantSecret
from gateway.northbound.requests.inbox import Inbox
from gateway.northbound.session.session import SecondSession
from gateway.plant.threads import off_loop
from gateway.tags.tag import NotReal

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

# Seconds that the start waits for the network. Without it the gateway serves all its devices, and
# claims them when the network is there.
NETWORK_WITHIN = 3.0
_QUERY_TIMEOUT = 0.7  # seconds
_LOOK_EVERY = 0.5  # seconds, where an event was lost
# Seconds between two queries: any client can declare tokens, and answer none of the queries.
_FIRST_PAUSE, _LONGEST_PAUSE = 0.5, 30.0
_MOST_EVENTS = 20_000  # of tokens, that wait for the event loop
_SETTLE = 0.05  # seconds in which more changes may arrive, to be treated together
_MOST_LOGGED = 10  # devices in one log entry


class Claiming:
    """Leaves devices that belong to other gateways to them: they are `withheld`."""

    def __init__(
        self,
        keys: Keys,
        group: str | None,
        secret: PlantSecret | None,
        devices: Iterable[str],
        admitted: asyncio.Event,
        refused: asyncio.Event,
    ) -> None:
        """`group`: the standby group. Sets `admitted` when the gateway may serve, `refused` when it
        must start over with other devices `withheld`."""
        self._admitted = admitted
        self._refused = refused
        self.withheld: Mapping[str, str] = {}  # with the gateways that serve them
        self.namesake = False  # another gateway with this name serves
        self.answered_elsewhere: str | None = None  # a key of which another program has answers
        self._keys = keys
        self._group = group
        self._devices = frozenset(devices)
        self._claims: Claims | None = None
        self._documents = ClaimDocuments(keys, secret)
        self._unanswered: set[str] = set()  # keys of claims that were seen but not read
        self._changed = asyncio.Event()
        # Zenoh undeclares an object without a reference.
        self._token: tuple[zenoh.Session, zenoh.LivelinessToken] | None = None
        self._declared: list[object] = []

    def withhold(self, devices: Mapping[str, str]) -> None:
        """Leaves devices to other gateways. Call it before `run`."""
        self.withheld = devices
        self._devices |= devices.keys()

    def taken(self, devices: Iterable[str]) -> Mapping[str, str]:
        """Returns those of the devices that other gateways serve, with their names."""
        return {} if self._claims is None else self._claims.taken(devices)

    async def change(self, devices: Iterable[str]) -> None:
        """Claims these devices, and no others any more. The token is declared again: then other
        gateways read the claim again."""
        self._devices = frozenset(devices)
        self.withheld = {name: g for name, g in self.withheld.items() if name in self._devices}
        if self._claims is None:
            return
        before = self._claims.own
        self._claims.change(self._devices, self.withheld)
        if self._claims.own != before and self._token is not None:
            session, token = self._token
            await off_loop(token.undeclare)
            await self._declare(session)

    def documents(self, origins: Mapping[str, NotReal]) -> dict[str, ClaimDocument]:
        """The own claim, by its path. `origins`: of devices that are not real."""
        own = None if self._claims is None else self._claims.own
        if own is None:
            return {}
        return {f"claim/{own.session}": self._documents.document(own, origins)}

    def status(self) -> dict[str, object]:
        """The fields of the gateway's status document."""
        return {
            "refused_devices": self.withheld,
            "refused_claims": self._documents.refused,
            "answered_elsewhere": self.answered_elsewhere,
        }

    async def notice_answers(
        self, session: zenoh.Session, key: Callable[[], str | None], every: float = 30.0
    ) -> None:
        """Asks other programs for the value at `key` until cancelled. A storage of Zenoh would
        answer with old values that look good. `session`: the gateway's own."""
        while True:
            await asyncio.sleep(every)  # a gateway whose place this one takes may answer still
            replies = [] if (asked := key()) is None else await off_loop(_query, session, asked)
            answered = any(reply.ok is not None for reply in replies)
            if answered and self.answered_elsewhere is None:
                log.warning(
                    "queries answered by another program", key=asked, effect="it may be old"
                )
            self.answered_elsewhere = asked if answered else None

    async def run(self, session: zenoh.Session, second: SecondSession) -> None:
        """Claims, then observes until cancelled. `session` is the gateway's own."""
        claims = self._claims = Claims(
            str(session.zid()), self._keys.gateway, self._group, self._devices
        )
        try:
            async with asyncio.timeout(NETWORK_WITHIN):
                view = await second.session()
                await self._look(view, self._keys.claims)
                if not self._must_start_over(claims):
                    await self._claim(session, claims)
                    if second.needed:
                        await self._until_seen(view, claims)
        except TimeoutError:
            log.warning(
                "own claim not seen", effect="other gateways with these devices go unnoticed"
            )
        if claims.own is None and not (claims.taken() or claims.namesake()):
            await self._claim(session, claims)
        if not self._must_start_over(claims):
            self._admitted.set()
        await self._observe(await second.session(), claims)

    async def _claim(self, session: zenoh.Session, claims: Claims) -> None:
        claims.claim(time.time_ns(), self.withheld)
        await self._declare(session)

    async def _declare(self, session: zenoh.Session) -> None:
        key = self._keys.claim(str(session.zid()))
        self._token = session, await off_loop(session.liveliness().declare_token, key)

    async def _until_seen(self, view: zenoh.Session, claims: Claims) -> None:
        """Waits until the own claim comes back: every later gateway sees it too."""
        own = claims.own
        while own is not None and self._keys.claim(own.session) not in await self._look(
            view, self._keys.claims
        ):
            await asyncio.sleep(0.05)

    async def _observe(self, view: zenoh.Session, claims: Claims) -> None:
        def seen(sample: zenoh.Sample) -> None:
            if len(self._unanswered) < MOST_OTHERS:
                self._unanswered.add(str(sample.key_expr))

        def token_changed(sample: zenoh.Sample, _at: float) -> None:
            key = str(sample.key_expr)
            if claims.own is not None and key == self._keys.claim(claims.own.session):
                return
            if sample.kind == zenoh.SampleKind.PUT:
                seen(sample)
                looks.begin()
            else:
                self._unanswered.discard(key)
                claims.lost(key.rpartition("/")[2])
                self._documents.forget(key)
            self._changed.set()

        looks = _Looks()
        inbox = Inbox(token_changed, seen, _MOST_EVENTS)
        tokens = zenoh.handlers.Callback(inbox, indirect=False)
        self._declared.append(
            await off_loop(
                lambda: view.liveliness().declare_subscriber(
                    self._keys.claims, tokens, history=True
                )
            )
        )
        while not self._must_start_over(claims):
            self._admitted.set()
            try:
                async with asyncio.timeout(_LOOK_EVERY):
                    await self._changed.wait()
            except TimeoutError:
                pass
            await asyncio.sleep(_SETTLE)
            self._changed.clear()
            if self._unanswered and looks.is_due(time.monotonic()):
                self._unanswered -= await self._look(view, self._keys.claims)

    def _must_start_over(self, claims: Claims) -> bool:
        if self._refused.is_set():
            return True
        if claims.namesake():
            self.namesake = True
            self.withheld = claims.taken()
            self._refused.set()
            return True
        if not claims.changed(self.withheld, time.monotonic()):
            return False
        taken = claims.taken()
        for device in sorted(taken.keys() - self.withheld.keys())[:_MOST_LOGGED]:
            log.error("device refused", device=device, why=f"gateway {taken[device]} serves it")
        for device in sorted(self.withheld.keys() - taken.keys())[:_MOST_LOGGED]:
            log.info("device free", device=device, effect="this gateway serves it again")
        self.withheld = taken
        self._refused.set()
        return True

    async def _look(self, view: zenoh.Session, key: str) -> set[str]:
        """Reads claims. Returns the keys of those that were answered."""
        replies = await off_loop(_query, view, key)
        found = {}
        for reply in replies:
            if reply.ok is None:
                continue
            key, data = str(reply.ok.key_expr), reply.ok.payload.to_bytes()
            if (claim := self._documents.parse(key, data, time.monotonic())) is not None:
                found[key] = claim
        for claim in found.values():
            if self._claims is not None:
                self._claims.found(claim)
        return set(found)


class _Looks:
    """Decides when claims are read again: soon after a new token, then ever more rarely."""

    def __init__(self) -> None:
        self._pause = 0.0
        self._last = -_LONGEST_PAUSE

    def begin(self) -> None:
        """A new token was seen."""
        self._pause = min(self._pause, _FIRST_PAUSE)

    def is_due(self, now: float) -> bool:
        if now - self._last < self._pause:
            return False
        self._last = now
        self._pause = min(max(2 * self._pause, _FIRST_PAUSE), _LONGEST_PAUSE)
        return True


def _query(view: zenoh.Session, key: str) -> list[zenoh.Reply]:
    """Returns at most `MOST_OTHERS` replies."""
    replies = view.get(
        key,
        timeout=_QUERY_TIMEOUT,
        consolidation=zenoh.ConsolidationMode.NONE,
        allowed_destination=zenoh.Locality.REMOTE,
    )
    return list(islice(replies, MOST_OTHERS))
