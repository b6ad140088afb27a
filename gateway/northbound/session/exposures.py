"""Warnings about endpoints that other machines can reach, made before the session opens."""

import ipaddress
import json
import re

import zenoh

_MAY_HOLD_SECRET = re.compile(r"passw|usrpwd|_base64", re.IGNORECASE)
_LOCAL_PROTOCOLS = ("unixsock-stream",)
_ENCRYPTED_PROTOCOLS = ("tls", "quic", *_LOCAL_PROTOCOLS)


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
