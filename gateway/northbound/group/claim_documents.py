"""The documents of claims, signed with the secret of the plant.

    {"ticket": …, "group": …, "devices": […], "signature": …}

The signature covers the key too, which has the names of the gateway and of its session.
"""

import orjson
import structlog

from gateway.contract.keys import Keys
from gateway.contract.rate_limit import RateLimit
from gateway.northbound.group.claims import Claim
from gateway.northbound.group.plant_secret import PlantSecret

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

_MOST_REFUSED = 10  # claims in the status
_SHOWN = 300  # characters of a refused key


class ClaimDocuments:
    """Makes documents, and parses those of other gateways."""

    def __init__(self, keys: Keys, secret: PlantSecret | None) -> None:
        """Without a `secret` claims are not signed, and every claim counts."""
        self._keys = keys
        self._secret = secret
        self._refused: dict[str, None] = {}  # keys, in the order of arrival
        self._log_limit = RateLimit(10, 60.0)  # any client can claim as often as it likes

    @property
    def refused(self) -> list[str]:
        """Keys of claims that count for nothing."""
        return [key[:_SHOWN] for key in self._refused]

    def forget(self, key: str) -> None:
        """The claim has ended."""
        self._refused.pop(key, None)

    def document(self, claim: Claim) -> dict[str, object]:
        document = _unsigned(claim)
        if self._secret is not None:
            text = _text(self._keys.claim(claim.session), document)
            document["signature"] = self._secret.signature(text)
        return document

    def parse(self, key: str, data: bytes, now: float) -> Claim | None:
        """Returns None for a document that is no claim, and for one that is not signed. Logs the
        latter once."""
        *_, name, _, session = key.split("/")
        try:
            document = orjson.loads(data)
        except orjson.JSONDecodeError:
            return None
        match document:
            case {"ticket": int(ticket), "group": str() | None as group, "devices": list(devices)}:
                known = frozenset(device for device in devices if isinstance(device, str))
                claim = Claim(ticket, session, name, group, known)
            case _:
                return None
        if self._secret is not None:
            signature = document.get("signature")
            text = _text(key, _unsigned(claim))
            if not (isinstance(signature, str) and self._secret.signed(text, signature)):
                self._refuse(key, now)
                return None
        self.forget(key)
        return claim

    def _refuse(self, key: str, now: float) -> None:
        if key in self._refused or len(self._refused) >= _MOST_REFUSED:
            return
        self._refused[key] = None
        if self._log_limit.allows(now):
            log.error(
                "claim refused",
                claim=key[:_SHOWN],
                why="it is not signed with the secret of this gateway",
            )


def _unsigned(claim: Claim) -> dict[str, object]:
    return {"ticket": claim.ticket, "group": claim.group, "devices": sorted(claim.devices)}


def _text(key: str, unsigned: dict[str, object]) -> str:
    return f"{key}\n{orjson.dumps(unsigned).decode()}"
