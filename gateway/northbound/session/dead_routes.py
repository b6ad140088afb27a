"""Lets Zenoh forget a router that has died.

A peer of Zenoh 1.10 keeps the route of a key that was asked through a router. When that router has
died, each query of the key gets all its replies, and then a time-out instead of the end, for ever.
Any session that links to the peer makes it find its routes again: one that comes and goes will do.
"""

import json
from pathlib import Path

import structlog
import zenoh

from gateway.contract.access import secrets
from gateway.errors import ConfigError
from gateway.northbound.session.session_settings import endpoints, reachable
from gateway.plant.threads import off_loop

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

_TLS = "transport/link/tls"
_PASSWORDS = "transport/auth/usrpwd"


async def forget(config: zenoh.Config) -> None:
    """Links a session to the session of `config` for a moment. Without a place for clients to
    connect to there is nothing to do."""
    if endpoints(config, "listen"):
        await off_loop(_visit, config)


def _visit(config: zenoh.Config) -> None:
    try:
        zenoh.open(visitor(config)).close()  # type: ignore[no-untyped-call]  # the stub lacks it
    except (zenoh.ZError, ConfigError) as error:
        log.warning("dead router kept", why=str(error), effect="queries of its keys end late")


def visitor(config: zenoh.Config) -> zenoh.Config:
    """Returns the configuration of a session that links to that of `config`. Reads the users."""
    copy = zenoh.Config.from_json5(str(config))
    here = [reachable(endpoint) for endpoint in endpoints(config, "listen")[:1]]
    settings = {
        "listen/endpoints": [],
        "connect/endpoints": here,
        "connect/timeout_ms": 1000,
        "connect/exit_on_failure": True,
        "access_control/enabled": False,
    }
    for side in ("certificate", "private_key"):
        settings[f"{_TLS}/connect_{side}"] = json.loads(config.get_json(f"{_TLS}/listen_{side}"))
    users = json.loads(config.get_json(f"{_PASSWORDS}/dictionary_file"))
    if users is not None:
        user, password = next(iter(secrets.users(Path(users)).items()))
        settings |= {f"{_PASSWORDS}/user": user, f"{_PASSWORDS}/password": password}
        settings[f"{_PASSWORDS}/dictionary_file"] = None
    for path, value in settings.items():
        copy.insert_json5(path, json.dumps(value))
    return copy
