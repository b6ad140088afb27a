"""The configuration of the Zenoh session, from the file and the files that it names."""

import json
from collections.abc import Sequence
from pathlib import Path

import zenoh

from gateway import files
from gateway.config import TlsConfig, ZenohConfig, ZenohMode
from gateway.config.settings import parsers
from gateway.contract.access import secrets
from gateway.errors import ConfigError
from gateway.northbound.session.exposures import describe_error

# ms until a link is open or given up: with TLS five round trips, over a satellite one second each.
# Zenoh takes 10 s, which a router behind a dead one would wait for.
HANDSHAKE = 5000
# The gateway's defaults, where Zenoh's do not fit. A value in the user's Zenoh file has priority.
_DEFAULTS: dict[str, object] = {
    "listen/endpoints": [],  # Zenoh's default is every interface
    "connect/retry": {"period_init_ms": 500, "period_max_ms": 4000, "period_increase_factor": 2},
    "open/return_conditions/connect_scouted": False,  # open returns in 1 ms, not in 500
    "scouting/multicast/enabled": False,
    "scouting/gossip/autoconnect": [],  # no links around the router and its access control
    "timestamping/enabled": True,
    "transport/shared_memory/enabled": False,
    "transport/unicast/open_timeout": HANDSHAKE,
    # Connections that say nothing keep new clients out, 100 of them for 10 s by default.
    "transport/unicast/accept_pending": 400,
    "transport/unicast/accept_timeout": HANDSHAKE,
    "transport/link/tx/lease": 3000,  # ms until the tokens of a frozen gateway end
    # µs. The default of 1 ms silently loses a part of every burst.
    "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 50_000,
    # µs without progress that a client may hold an answering thread before its link is closed: the
    # client closes it too after the lease.
    "transport/link/tx/queue/congestion_control/block/wait_before_close": 3_000_000,
    # Bytes of a socket. With the megabytes that Linux takes, a slow client behind large buffers
    # makes no room for seconds although it reads all the time, and its link would be closed. Zenoh
    # sends by priority, but not what is in the socket already: at 1 Mbit/s these are half a second.
    "transport/link/tcp/so_sndbuf": 32 * 1024,
    # A link ends when nothing arrives for the lease, and only a whole batch counts as arrived.
    # Zenoh's default of 64 kB takes 8 s at 64 kbit/s; this takes 1 s.
    "transport/link/tx/batch_size": 8192,
    # Puts and declarations come in bursts. A write that was done shall not wait behind much of a
    # long answer.
    "transport/link/tx/queue/size/control": 16,
    "transport/link/tx/queue/size/interactive_high": 16,  # alarms and outcomes
    "transport/link/tx/queue/size/data": 4,
    "transport/link/tx/queue/size/data_low": 16,
}
# A router forwards the messages of others; any other gateway receives only writes, which are short.
_LONGEST_MESSAGE = {"transport/link/rx/max_message_size": 256 * 1024}


def configure(settings: ZenohConfig) -> zenoh.Config:
    """Returns the session's configuration. Raises `ConfigError` for a bad file or endpoint."""
    config = zenoh.Config() if settings.config_file is None else _from_file(settings.config_file)
    untouched = zenoh.Config()
    defaults = _DEFAULTS if settings.mode is ZenohMode.ROUTER else _DEFAULTS | _LONGEST_MESSAGE
    for path, setting in defaults.items():
        if config.get_json(path) == untouched.get_json(path):
            config.insert_json5(path, json.dumps(setting))
    config.insert_json5("mode", json.dumps(settings.mode.value))
    if settings.mode is ZenohMode.CLIENT:
        _try_each_once(config)
    for path, value in (_tls(settings.tls) | _users(settings)).items():
        config.insert_json5(path, json.dumps(value))
    for side, endpoints in (("listen", settings.listen), ("connect", settings.connect)):
        for endpoint in endpoints:
            _check(side, endpoint)
        if endpoints:
            config.insert_json5(f"{side}/endpoints", json.dumps(endpoints))
    _check_listen(config, settings.listen)
    if settings.mode is ZenohMode.CLIENT and json.loads(config.get_json("connect/endpoints")) == []:
        raise ConfigError("zenoh mode client: name its router in `connect`")
    return config


def _check_listen(config: zenoh.Config, listen: Sequence[str]) -> None:
    """Raises `ConfigError` for an endpoint that needs a certificate and has none."""
    link = "transport/link/tls/listen_certificate"
    if any(config.get_json(name) != "null" for name in (link, f"{link}_base64")):
        return
    for endpoint in listen:
        if endpoint.startswith(("tls/", "quic/")) and "#" not in endpoint:
            raise ConfigError(
                f"zenoh listen {endpoint!r}: it needs a certificate: write beside `listen` "
                "`tls: {certificate: gateway.pem, key: gateway.key}`"
            )


def drop_limit(config: zenoh.Config) -> float:
    """Returns the seconds that a put waits for room on a full link before Zenoh drops it."""
    path = "transport/link/tx/queue/congestion_control/drop/wait_before_drop"
    return float(json.loads(config.get_json(path))) / 1e6


def as_client(config: zenoh.Config) -> zenoh.Config:
    """Returns the same configuration for a second session: a client without endpoints."""
    copy = zenoh.Config.from_json5(str(config))
    copy.insert_json5("mode", '"client"')
    copy.insert_json5("listen/endpoints", "[]")
    _try_each_once(copy)
    return copy


def _try_each_once(config: zenoh.Config) -> None:
    """`open_session` retries. With a time for all endpoints Zenoh's client spends it at the first
    one; without it, for ever, in its thread."""
    config.insert_json5("connect/timeout_ms", "0")


def reachable(endpoint: str) -> str:
    """Replaces the address of all interfaces by the one of this machine."""
    return endpoint.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")


def endpoints(config: zenoh.Config, side: str) -> list[str]:
    """Returns the endpoints to `listen` at or to `connect` to, without their settings."""
    found = json.loads(config.get_json(f"{side}/endpoints"))
    if isinstance(found, dict):  # by mode
        found = found.get(json.loads(config.get_json("mode")), [])
    return [str(endpoint).partition("#")[0] for endpoint in found or ()]


def _from_file(path: Path) -> zenoh.Config:
    called = "zenoh config_file"
    text = ""
    try:
        text = files.read(path, files.MOST_OF_SECRETS).decode()
        config = zenoh.Config.from_json5(text)
    except OSError as error:
        raise ConfigError(f"{called} {path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{called} {path} is no UTF-8 text") from None
    except zenoh.ZError as error:
        raise ConfigError(f"{called} {path}: {describe_error(error, text)}") from None
    if secrets.holds_secret(text):
        secrets.closed_to_others(path, f"{called} holds a secret, and")
    return config


def _tls(tls: TlsConfig | None) -> dict[str, object]:
    """Returns Zenoh's settings; incoming and outgoing links use the same certificate."""
    if tls is None:
        return {}
    from gateway.contract.access.certificates import check_files  # its TLS takes 10 ms

    if tls.key is not None:
        secrets.closed_to_others(tls.key, "zenoh.tls.key")
    check_files(tls)
    files = {
        "root_ca_certificate": tls.ca,
        "listen_certificate": tls.certificate,
        "listen_private_key": tls.key,
        "connect_certificate": tls.certificate if tls.mutual else None,
        "connect_private_key": tls.key if tls.mutual else None,
    }
    found: dict[str, object] = {name: str(file) for name, file in files.items() if file}
    found["enable_mtls"] = tls.mutual
    return {f"transport/link/tls/{name}": value for name, value in found.items()}


def _users(settings: ZenohConfig) -> dict[str, object]:
    found: dict[str, object] = {}
    if settings.users_file is not None:
        secrets.users(settings.users_file)
        found["transport/auth/usrpwd/dictionary_file"] = str(settings.users_file)
    if settings.user is not None:
        password = secrets.password(settings.password_file)
        if password is None:
            raise ConfigError(
                f"zenoh.user {settings.user} has no password: name a password_file, or set "
                f"{secrets.PASSWORD_VARIABLE}"
            )
        found["transport/auth/usrpwd/user"] = settings.user
        found["transport/auth/usrpwd/password"] = password
    return found


def _check(side: str, endpoint: str) -> None:
    try:
        parsers.check_address(endpoint)
    except ConfigError as error:
        raise ConfigError(f"zenoh {side} {error}") from None
