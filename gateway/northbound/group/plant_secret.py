"""The secret that the gateways of a plant share. It signs their tokens and claims.

Any program that is connected can declare a token or answer a query. Without the secret it can sign
nothing. The secret itself is never sent.
"""

import hashlib
import hmac

_LENGTH = 32  # hexadecimal digits


class PlantSecret:
    """Signs texts, and checks the signatures of other gateways."""

    def __init__(self, secret: str) -> None:
        self._secret = secret.encode()

    def signature(self, text: str) -> str:
        return hmac.new(self._secret, text.encode(), hashlib.sha256).hexdigest()[:_LENGTH]

    def signed(self, text: str, signature: str) -> bool:
        return hmac.compare_digest(self.signature(text).encode(), signature.encode())
