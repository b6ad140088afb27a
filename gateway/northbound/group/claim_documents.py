"""The documents of claims, signed with the secret of the plant.

    {"contract": 1, "ticket": …, "group": …, "devices": […], "signature": …}

The signature covers the key too, which has the names of the gateway and of its session.
"""

from collections.abc import Mapping

import orjson
import structlog

from gateway.contract.documents.state import ClaimDocument
from gateway.contract.foreign import Foreign
from gateway.contract.keys import CONTRACT, Keys
from gateway.contract.rate_limit import RateLimit
from gateway.errors import BadValue
from gateway.northbound.group.claims import LAST_TICKET, Claim
from gateway.northbound.group.plant_secret import PlantSecret
from gateway.tags.tag import NotReal

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

_LONGEST = 256 * 1024  # bytes of a document; Zenoh drops longer messages
_MOST_DEVICES = 10_000
_LONGEST_NAME = 300  # characters
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

    def document(self, claim: Claim, origins: Mapping[str, NotReal]) -> ClaimDocument:
        """`origins`: of devices that are not real."""
        # Number and origins are not signed: a gateway of an earlier version does not know them.
        document: ClaimDocument = {
            "contract": CONTRACT,
            "ticket": claim.ticket,
            "group": claim.group,
            "devices": sorted(claim.devices),
        }
        if known := {name: word for name, word in origins.items() if name in claim.devices}:
            document["origins"] = known
        if self._secret is not None:
            text = _text(self._keys.claim(claim.session), _unsigned(claim))
            document["signature"] = self._secret.signature(text)
        return document

    def parse(self, key: str, data: bytes, now: float) -> Claim | None:
        """Returns None for a document that is no claim, and for one that is not signed. Logs it
        once."""
        try:
            claim = self._signed(key, Foreign.parse(data, _LONGEST))
        except BadValue as error:
            self._refuse(key, str(error), now)
            return None
        self.forget(key)
        return claim

    def _signed(self, key: str, document: Foreign) -> Claim:
        """Raises `BadValue`."""
        *_, name, _, session = key.split("/")
        claim = Claim(
            document.number("ticket", 0, LAST_TICKET),
            session,
            name,
            document.text_or_none("group", _LONGEST_NAME),
            document.texts("devices", _MOST_DEVICES, _LONGEST_NAME),
        )
        if self._secret is not None:
            signature = document.text_or_none("signature", _LONGEST_NAME) or ""
            if not self._secret.signed(_text(key, _unsigned(claim)), signature):
                raise BadValue("it is not signed with the secret of this gateway")
        return claim

    def _refuse(self, key: str, why: str, now: float) -> None:
        if key in self._refused or len(self._refused) >= _MOST_REFUSED:
            return
        self._refused[key] = None
        if self._log_limit.allows(now):
            log.error("claim refused", claim=key[:_SHOWN], why=why)


def _unsigned(claim: Claim) -> dict[str, object]:
    return {"ticket": claim.ticket, "group": claim.group, "devices": sorted(claim.devices)}


def _text(key: str, unsigned: dict[str, object]) -> str:
    return f"{key}\n{orjson.dumps(unsigned).decode()}"
