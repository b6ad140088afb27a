"""The code of an invitation: name, address of the authority, secret, fingerprint."""

import re
import secrets
from typing import NamedTuple, Self

from gateway.errors import ConfigError

_CODE = re.compile(
    r"(?P<name>[^@/\s]{1,64})@(?P<at>[^@/\s]{3,260})"
    r"/(?P<secret>[\w-]{22})/(?P<fingerprint>[0-9a-f]{64})\Z",
    re.ASCII,
)


class Code(NamedTuple):
    """One invitation, as a person carries it to the gateway.

    `at`: host and port of the authority. `secret`: 128 random bits. `fingerprint`: SHA-256 of the
    authority's certificate, so that the newcomer knows the authority before it sends anything.
    """

    name: str
    at: str
    secret: str
    fingerprint: str

    def __str__(self) -> str:
        return f"{self.name}@{self.at}/{self.secret}/{self.fingerprint}"

    @classmethod
    def parsed(cls, text: str) -> Self:
        """Raises `ConfigError`, without the secret."""
        match = _CODE.match(text.strip())
        if match is None:
            raise ConfigError(
                "this is no whole code: it looks like name@authority:8444/secret/fingerprint"
            )
        return cls(**match.groupdict())


def new_secret() -> str:
    return secrets.token_urlsafe(16)
