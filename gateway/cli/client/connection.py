"""Connects to a running gateway: its endpoints, and the user of the command line."""

import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import zenoh

from gateway import config as configuration
from gateway.cli.client.client import Client, NoGateway
from gateway.cli.progress import busy
from gateway.config import ZenohConfig, ZenohMode
from gateway.config.gateway_address import address
from gateway.errors import ConfigError, GatewayError
from gateway.northbound.session.session_settings import configure, reachable

if TYPE_CHECKING:
    from gateway.config import Config
    from gateway.config.gateway_address import GatewayAddress

USER_VARIABLE = "PLC_GATEWAY_CLI_USER"
PASSWORD_VARIABLE = "PLC_GATEWAY_CLI_PASSWORD"  # noqa: S105  (the name of a variable)
_USER = "transport/auth/usrpwd/user"
# Settings of the gateway's Zenoh file for its own clients: they must not apply here.
_OPEN: dict[str, object] = {
    "listen/endpoints": [],
    "access_control/enabled": False,
    "transport/auth/usrpwd/dictionary_file": None,
    "transport/link/rx/max_message_size": 2**30,  # Zenoh's own: the gateway's is short
}


AGAIN = 0.5  # seconds between two tries of a command that waits for its gateway


@contextmanager
def reached(path: Path, tell: Callable[[str], None], *, waits: bool = False) -> Iterator[Client]:
    """Yields a client of the gateway of a file, and reads only the address in it.

    The client has no tags: for status and alarms. Where it fails, the file is checked as a whole,
    because a mistake in it may be the reason. Raises as `load` and `connected`.
    """
    try:
        with connected(address(path) or configuration.load(path), tell, waits=waits) as client:
            yield client
    except GatewayError:
        configuration.load(path)
        raise


@contextmanager
def connected(
    config: "Config | GatewayAddress", tell: Callable[[str], None], *, waits: bool = False
) -> Iterator[Client]:
    """Yields a client of the gateway that `config` describes. `tell` gets sentences for people.

    The client uses the user of the environment variables, or else the gateway's own. Raises
    `NoGateway` when no gateway is reachable, unless it `waits`, and `GatewayError` when the gateway
    stands still or refuses the user.
    """
    endpoints = _endpoints(config)
    if not endpoints:
        raise NoGateway("zenoh.listen and zenoh.connect are empty: no gateway can be reached")
    setup = _setup(config.zenoh, endpoints)
    user = json.loads(setup.get_json(_USER))
    opened = partial(_opened, setup, endpoints, user)
    session = _awaited(opened, tell) if waits else opened()
    try:
        yield Client(session, config, tell, user)
    finally:
        with suppress(zenoh.ZError):  # may time out when the gateway hangs
            session.close()  # type: ignore[no-untyped-call]  # Zenoh's stub lacks it


def _awaited(opened: Callable[[], zenoh.Session], tell: Callable[[str], None]) -> zenoh.Session:
    said = False
    while True:
        try:
            return opened()
        except NoGateway as error:
            if not said:
                tell(f"{error}; waiting for it")
                said = True
        time.sleep(AGAIN)


def _opened(setup: zenoh.Config, endpoints: tuple[str, ...], user: str | None) -> zenoh.Session:
    """Raises `NoGateway`, `GatewayError`."""
    try:
        with busy(f"connecting to {endpoints[0]}"):
            return zenoh.open(setup)
    except zenoh.ZError:
        from gateway.cli.client.diagnosis import connection_failure  # its TLS takes 10 ms

        hint = f"set {USER_VARIABLE} and {PASSWORD_VARIABLE}"
        if why := connection_failure(setup, endpoints, user, hint):
            raise GatewayError(why) from None
        raise NoGateway(
            f"no gateway at {', '.join(endpoints)}: start it with `plc-gateway run`, or use "
            "--direct"
        ) from None


def _endpoints(config: "Config | GatewayAddress") -> tuple[str, ...]:
    """Returns the endpoints to try, in order."""
    own = config.zenoh
    if own.mode == "client":
        return own.connect
    here = tuple(reachable(endpoint) for endpoint in own.listen)
    if config.standby is None:
        return here or own.connect
    return own.connect + here  # another member of the group may be active


def _setup(own: ZenohConfig, endpoints: tuple[str, ...]) -> zenoh.Config:
    """Returns the Zenoh configuration. Reads no secret of the gateway that it does not need.

    The user of the command line may have no access to the files of the gateway.
    """
    settings = replace(own, mode=ZenohMode.CLIENT, listen=(), connect=endpoints, users_file=None)
    if own.tls is not None and not own.tls.mutual:
        settings = replace(settings, tls=replace(own.tls, certificate=None, key=None))
    user = _user()
    if user:
        settings = replace(settings, user=None, password_file=None)
    setup = configure(settings)
    for path, value in (_OPEN | user).items():
        setup.insert_json5(path, json.dumps(value))
    return setup


def _user() -> dict[str, object]:
    """Returns the settings for the user of the environment variables, or none."""
    user, password = os.environ.get(USER_VARIABLE), os.environ.get(PASSWORD_VARIABLE)
    if not user and not password:
        return {}
    if not user or not password:
        raise ConfigError(f"{USER_VARIABLE} and {PASSWORD_VARIABLE} belong together: set both")
    return {_USER: user, "transport/auth/usrpwd/password": password}
