"""The keys of the liveliness tokens of a standby group, signed with the secret of the plant.

<prefix>/@standby/<group>/<role>/<gateway>/<session>/<signature>
"""

import hmac

import structlog

from gateway.contract.keys import Keys
from gateway.contract.rate_limit import RateLimit
from gateway.northbound.group.election import Role, RoleToken
from gateway.northbound.group.plant_secret import PlantSecret

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

_SHOWN = 300  # characters of a refused key


class GroupTokens:
    """Makes keys, and parses those of other gateways."""

    def __init__(self, keys: Keys, group: str, secret: PlantSecret | None) -> None:
        """Without a `secret` tokens are not signed, and every token of the group counts."""
        self._keys = keys
        self._stem = keys.group(group)
        self._secret = secret
        self._log_limit = RateLimit(10, 60.0)  # any client can declare as many as it likes

    @property
    def all(self) -> str:
        return f"{self._stem}/**"

    def key(self, token: RoleToken) -> str:
        key = f"{self._stem}/{token.role.value}/{token.name}/{token.session}"
        return key if self._secret is None else f"{key}/{self._secret.signature(key)}"

    def parse(self, key: str, now: float) -> RoleToken | None:
        """Returns None, and logs the key, for a token that this group did not sign."""
        match key.removeprefix(f"{self._stem}/").split("/"):
            case [role, name, session, *signature] if role in list(Role):
                token = RoleToken(Role(role), name, session)
                if self._secret is None and len(signature) <= 1:
                    return token
                if self._secret and hmac.compare_digest(key.encode(), self.key(token).encode()):
                    return token
        if self._log_limit.allows(now):
            log.error(
                "standby token refused",
                token=key[:_SHOWN],
                why="it is not signed with the secret of this gateway",
            )
        return None
