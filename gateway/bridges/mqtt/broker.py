"""The way to a broker: one after the other, again and again."""

import asyncio
import os
import ssl
from collections.abc import Awaitable, Callable, Sequence
from itertools import cycle
from urllib.parse import urlsplit

import aiomqtt

from gateway.bridges.program import say
from gateway.errors import ConfigError

RECONNECT_AFTER = 1.0  # seconds
KEEP_ALIVE = 10  # seconds: after one and a half of it the broker publishes the last will


def checked(addresses: Sequence[str]) -> None:
    """Raises `ConfigError` for an address that is none."""
    for address in addresses:
        try:
            where = urlsplit(address)
            is_one = where.scheme in ("mqtt", "mqtts") and where.hostname and where.port != 0
        except ValueError:
            is_one = None
        if not is_one:
            raise ConfigError(f"--broker {address}: mqtt://host:port or mqtts://user@host:port")


def client(
    address: str, identifier: str, will: aiomqtt.Will, version: aiomqtt.ProtocolVersion
) -> aiomqtt.Client:
    """Returns a client. `MQTT_PASSWORD` is the password of the user in the address.

    With the same identifier again the broker ends an old connection first, with its last will. No
    command waits at the broker.
    """
    where = urlsplit(address)
    secure = where.scheme == "mqtts"
    return aiomqtt.Client(
        where.hostname or "127.0.0.1",
        where.port or (8883 if secure else 1883),
        username=where.username,
        password=os.environ.get("MQTT_PASSWORD"),
        tls_context=ssl.create_default_context() if secure else None,
        identifier=identifier,
        protocol=version,
        keepalive=KEEP_ALIVE,
        will=will,
        # MQTT 5 has `clean_start` instead: aiomqtt sets it for the first session of a client.
        clean_session=None if version is aiomqtt.ProtocolVersion.V5 else True,
    )


async def sessions(
    addresses: Sequence[str],
    opened: Callable[[str], aiomqtt.Client],
    session: Callable[[aiomqtt.Client], Awaitable[None]],
) -> None:
    """Serves at one broker until the session or the connection ends, then at the next."""
    for address in cycle(addresses):
        try:
            async with opened(address) as broker:
                await session(broker)
        except* aiomqtt.MqttError as errors:
            say(f"broker: {errors.exceptions[0]}")
        await asyncio.sleep(RECONNECT_AFTER)
