"""Signatures of writes and commands: proof of the writer's secret that does not send it.

The attachment of a signed query or put is `{"by": …, "time": …, "nonce": …, "signature": …}`. The
signature is HMAC-SHA256 in hexadecimal over these lines: by, time, nonce, key, payload.
"""

import hashlib
import hmac
import re
import secrets
from datetime import datetime
from typing import NamedTuple

import orjson

from gateway.contract.foreign import Foreign
from gateway.errors import BadValue

LONGEST = 1000  # bytes of an attachment
_NAME = re.compile(r"[\w.\-]{1,60}\Z")
_NONCE = re.compile(r"[\w.\-]{16,64}\Z")


class Signed(NamedTuple):
    """The attachment of a signed write. `time` as sent."""

    by: str
    time: str
    nonce: str
    signature: str

    @property
    def made(self) -> float:
        """Seconds since 1970."""
        return datetime.fromisoformat(self.time).timestamp()

    def matches(self, secret: bytes, key: str, data: bytes) -> bool:
        return hmac.compare_digest(_signature(secret, self, key, data), self.signature.lower())


def sign(by: str, secret: str, time: str, key: str, data: bytes) -> bytes:
    """Returns the attachment. `time`: RFC 3339."""
    unsigned = Signed(by, time, secrets.token_hex(16), "")
    signature = _signature(secret.encode(), unsigned, key, data)
    return orjson.dumps(unsigned._replace(signature=signature)._asdict())


def parse(attachment: bytes | None) -> Signed | None:
    """Returns None where the attachment is no signature of this form."""
    try:
        found = Foreign.parse(attachment or b"", LONGEST)
        by, time, nonce, signature = (found.text(name, LONGEST) for name in Signed._fields)
        aware = datetime.fromisoformat(time).tzinfo is not None
    except (BadValue, ValueError):
        return None
    wrong = "\n" in time or not (aware and signature.isascii())
    if wrong or not (_NAME.match(by) and _NONCE.match(nonce)):
        return None
    return Signed(by, time, nonce, signature)


def _signature(secret: bytes, signed: Signed, key: str, data: bytes) -> str:
    lines = f"{signed.by}\n{signed.time}\n{signed.nonce}\n{key}\n".encode()
    return hmac.new(secret, lines + data, hashlib.sha256).hexdigest()
