"""Checks of secret files and of open endpoints, made before the session opens.

No message here shows the content of a file.
"""

import ipaddress
import json
import os
import re
import stat
from pathlib import Path

import zenoh

from gateway.errors import ConfigError

PASSWORD_VARIABLE = "PLC_GATEWAY_ZENOH_PASSWORD"  # noqa: S105  (the name of a variable)
SHORTEST_SECRET = 20  # characters of the secret of a plant
_SECRET = re.compile(r"""["']?(password|\w*_base64)["']?\s*:\s*["'\d]""")
_MAY_HOLD_SECRET = re.compile(r"passw|usrpwd|_base64", re.IGNORECASE)
_LOCAL_PROTOCOLS = ("unixsock-stream",)
_ENCRYPTED_PROTOCOLS = ("tls", "quic", *_LOCAL_PROTOCOLS)


def closed_to_others(path: Path, called: str) -> None:
    """Raises `ConfigError` if every user of this machine can read or change the file."""
    try:
        mode = path.stat().st_mode
    except OSError as error:
        raise ConfigError(f"{called} {path}: {error.strerror}") from None
    if os.name == "posix" and mode & (stat.S_IROTH | stat.S_IWOTH):
        raise ConfigError(
            f"{called} {path} is open to every user of this machine: run chmod o-rwx {path}"
        )


def readable_secret(path: Path, called: str) -> str:
    """Returns the text of a file that is closed to others. Raises `ConfigError`."""
    closed_to_others(path, called)
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{called} {path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{called} {path} is no UTF-8 text") from None


def password(file: Path | None) -> str | None:
    """Returns the file's first line, or without a file the environment's password. Raises
    `ConfigError`."""
    if file is None:
        return os.environ.get(PASSWORD_VARIABLE) or None
    found = readable_secret(file, "zenoh.password_file").partition("\n")[0].strip()
    if not found:
        raise ConfigError(f"zenoh.password_file {file} has an empty first line")
    return found


def plant_secret(file: Path | None) -> str | None:
    """Returns the first line of the secret of the gateways of a plant. Raises `ConfigError`."""
    if file is None:
        return None
    called = "gateway.secret_file"
    found = readable_secret(file, called).partition("\n")[0].strip()
    if len(found) < SHORTEST_SECRET:
        raise ConfigError(
            f"{called} {file}: its first line has fewer than {SHORTEST_SECRET} characters"
        )
    return found


def check_users(path: Path) -> None:
    """Raises `ConfigError` for a file that Zenoh would refuse, or without any user: Zenoh would
    then accept every connection."""
    named = False
    for number, line in enumerate(readable_secret(path, "zenoh.users_file").splitlines(), 1):
        name, _, password = line.partition(":")
        if line.strip():
            if not name.strip() or not password.strip():
                raise ConfigError(
                    f"zenoh.users_file {path}, line {number}: write it as name:password"
                )
            named = True
    if not named:
        raise ConfigError(
            f"zenoh.users_file {path} names no user, so the gateway would accept every connection"
        )


def holds_secret(zenoh_file: str) -> bool:
    """True if the text of a Zenoh file contains a password or a private key."""
    return _SECRET.search(zenoh_file) is not None


def describe_error(error: zenoh.ZError, zenoh_file: str) -> str:
    """Returns the error in a Zenoh file, without a quotation if the file may hold a secret."""
    text = str(error)
    if not _MAY_HOLD_SECRET.search(zenoh_file):
        return text
    place = re.search(r"--> (\d+):\d+", text)
    return (
        "it is wrong" + (f" in line {place[1]}" if place else "") + "; it may hold a password, "
        "so no more is shown"
    )


def exposures(config: zenoh.Config) -> list[str]:
    """Returns warnings about endpoints that other machines can reach, as sentences."""
    endpoints = [str(endpoint) for endpoint in _endpoints(config)]
    reachable = [endpoint for endpoint in endpoints if not _is_local(endpoint)]
    if not reachable:
        return []
    warnings, places = [], ", ".join(reachable)
    authenticates = (
        _setting(config, "transport/auth/usrpwd/dictionary_file") is not None
        or _setting(config, "transport/link/tls/enable_mtls") is True
        or _setting(config, "transport/auth/pubkey/known_keys_file") is not None
    )
    rules = _setting(config, "access_control/enabled") is True and (
        _setting(config, "access_control/default_permission") == "deny"
    )
    if not authenticates and not rules:
        warnings.append(
            f"other machines can reach {places}, and nothing protects it: any client may read "
            "every value and write every writable tag; see docs/security.md"
        )
    unencrypted = [one for one in reachable if one.partition("/")[0] not in _ENCRYPTED_PROTOCOLS]
    if authenticates and unencrypted:
        warnings.append(
            f"passwords and values travel in the clear on {', '.join(unencrypted)}: use tls/"
        )
    return warnings


def unsigned() -> list[str]:
    """Returns the warning about a standby group without a secret."""
    warning = (
        "`standby` without `secret_file`: any program that connects can take both gateways "
        "off the wire; see docs/standby.md"
    )
    return [warning]


def unruled(config: zenoh.Config) -> list[str]:
    """Returns a warning, as a sentence, if clients connect here and no rules restrict their keys:
    for a gateway that knows its writers."""
    if not _endpoints(config) or _setting(config, "access_control/enabled") is True:
        return []
    warning = (
        "`writers` without access_control: any program that connects can answer a write in place "
        "of the gateway, and publish values; see docs/access-control.md"
    )
    return [warning]


def _endpoints(config: zenoh.Config) -> list[object]:
    found = _setting(config, "listen/endpoints")
    if isinstance(found, dict):  # by mode
        mode = _setting(config, "mode")
        found = found.get(mode) if isinstance(mode, str) else None
    return found if isinstance(found, list) else []


def _setting(config: zenoh.Config, path: str) -> object:
    found: object = json.loads(config.get_json(path))
    return found


def _is_local(endpoint: str) -> bool:
    protocol, _, address = endpoint.partition("/")
    if protocol in _LOCAL_PROTOCOLS:
        return True
    host = address.partition("?")[0].partition("#")[0].rpartition(":")[0].strip("[]")
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
