"""The way to a running gateway: where it is, and as whom the command line comes."""

import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace

import zenoh

from gateway.cli.client.client import Client
from gateway.cli.client.refusal import why_not
from gateway.config import Config, ZenohConfig, ZenohMode
from gateway.errors import ConfigError, GatewayError
from gateway.northbound.session import configure

USER_VARIABLE = "PLC_GATEWAY_CLI_USER"
PASSWORD_VARIABLE = "PLC_GATEWAY_CLI_PASSWORD"  # noqa: S105  (the name of a variable)
_USER = "transport/auth/usrpwd/user"
# What a Zenoh file says of those who connect to the gateway is not meant for this session.
_OPEN: dict[str, object] = {
    "listen/endpoints": [],
    "access_control/enabled": False,
    "transport/auth/usrpwd/dictionary_file": None,
}


@contextmanager
def connected(config: Config, tell: Callable[[str], None]) -> Iterator[Client]:
    """A client of the gateway that `config` describes, which may `tell` people something.

    It comes as the user of the environment, or else as the gateway itself. Raises `GatewayError`
    when none is there, or it does not let us in.
    """
    endpoints = _endpoints(config)
    if not endpoints:
        raise GatewayError("zenoh.listen and zenoh.connect are empty: no way to the gateway")
    setup = _setup(config.zenoh, endpoints)
    user = json.loads(setup.get_json(_USER))
    try:
        session = zenoh.open(setup)
    except zenoh.ZError:
        ways = f"set {USER_VARIABLE} and {PASSWORD_VARIABLE}"
        raise GatewayError(why_not(setup, endpoints, user, ways)) from None
    try:
        yield Client(session, config, tell, user)
    finally:
        with suppress(zenoh.ZError):  # it times out now and then where the gateway is frozen
            session.close()  # type: ignore[no-untyped-call]  # Zenoh's stub lacks it


def _endpoints(config: Config) -> tuple[str, ...]:
    """Where to connect: the first that is there is taken."""
    own = config.zenoh
    if own.mode == "client":
        return own.connect
    here = tuple(_reachable(endpoint) for endpoint in own.listen)
    if config.standby is None:
        return here or own.connect
    return own.connect + here  # another of the group may serve, and is seen from there


def _reachable(endpoint: str) -> str:
    """An endpoint that listens everywhere is reached on this machine."""
    return endpoint.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")


def _setup(own: ZenohConfig, endpoints: tuple[str, ...]) -> zenoh.Config:
    """As little as there is to read of the gateway's own secrets: who runs this may be somebody
    else."""
    settings = replace(own, mode=ZenohMode.CLIENT, listen=(), connect=endpoints, users_file=None)
    if own.tls is not None and not own.tls.mutual:
        settings = replace(settings, tls=replace(own.tls, certificate=None, key=None))
    person = _person()
    if person:
        settings = replace(settings, user=None, password_file=None)
    setup = configure(settings)
    for path, value in (_OPEN | person).items():
        setup.insert_json5(path, json.dumps(value))
    return setup


def _person() -> dict[str, object]:
    """Whoever types this, where a name and a password are given; nothing otherwise."""
    user, password = os.environ.get(USER_VARIABLE), os.environ.get(PASSWORD_VARIABLE)
    if not user and not password:
        return {}
    if not user or not password:
        raise ConfigError(f"{USER_VARIABLE} and {PASSWORD_VARIABLE} belong together: set both")
    return {_USER: user, "transport/auth/usrpwd/password": password}
