"""Notices a second process of the same gateway on this machine, also without any network."""

import errno
import hashlib
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from gateway.errors import GatewayError


@contextmanager
def only_process(gateway: str, *endpoints: str) -> Iterator[None]:
    """Holds the name of the gateway on this machine. Raises `GatewayError` if another process
    does.

    `gateway`: its own key. `endpoints`: a machine may have separate networks.
    The system frees the name when the process ends, however it ends. Only Linux has such names.
    """
    if sys.platform != "linux":
        yield
        return
    name = hashlib.sha256("\n".join((gateway, *endpoints)).encode()).hexdigest()
    with socket.socket(socket.AF_UNIX) as held:
        try:
            held.bind(f"\0zenoh-plc-gateway {name}")
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                raise GatewayError(
                    f"{gateway} runs already on this machine: a second process would poll and "
                    "write twice"
                ) from None
            # Otherwise the system forbids such names: claims on the network remain.
        yield
