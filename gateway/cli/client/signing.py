"""Signs writes and commands with the secret of the user of the command line."""

import os
import time

from gateway.contract.access.signatures import sign
from gateway.errors import ConfigError
from gateway.tags.timestamps import rfc3339

WRITER_VARIABLE = "PLC_GATEWAY_WRITER"
OLD_VARIABLE = "PLC_GATEWAY_WRITE_TOKEN"  # of a version that sent its token


def signature(key: str, payload: bytes) -> bytes | None:
    """Signs with the secret of the environment variable, if it is set. Raises `ConfigError`."""
    writer = os.environ.get(WRITER_VARIABLE)
    if not writer:
        if os.environ.get(OLD_VARIABLE):
            raise ConfigError(
                f"{OLD_VARIABLE}: tokens are no longer sent; set {WRITER_VARIABLE} to name:secret, "
                "as in the writers file"
            )
        return None
    name, _, secret = writer.partition(":")
    if not name or not secret:
        raise ConfigError(f"{WRITER_VARIABLE} is not name:secret, as in the writers file")
    return sign(name, secret, rfc3339(time.time_ns()), key, payload)
