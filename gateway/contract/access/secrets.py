"""Checks of secret files, made before the session opens.

No message here shows the content of a file.
"""

import os
import re
import stat
from collections.abc import Mapping
from pathlib import Path

from gateway import files
from gateway.errors import ConfigError

PASSWORD_VARIABLE = "PLC_GATEWAY_ZENOH_PASSWORD"  # noqa: S105  (the name of a variable)
SHORTEST_SECRET = 20  # characters of the secret of a plant
_SECRET = re.compile(r"""["']?(password|\w*_base64)["']?\s*:\s*["'\d]""")


def closed_to_others(path: Path, called: str) -> None:
    """Raises `ConfigError` if every user of this machine can read or change the file."""
    try:
        mode = path.stat().st_mode
    except OSError as error:
        raise ConfigError(f"{called} {path}: {error.strerror}") from None
    if mode & (stat.S_IROTH | stat.S_IWOTH):
        raise ConfigError(
            f"{called} {path} is open to every user of this machine: run chmod o-rwx {path}"
        )


def readable_secret(path: Path, called: str) -> str:
    """Returns the text of a file that is closed to others. Raises `ConfigError`."""
    closed_to_others(path, called)
    try:
        return files.read(path, files.MOST_OF_SECRETS).decode()
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


def users(path: Path) -> Mapping[str, str]:
    """Returns the passwords by user. Raises `ConfigError` for a file that Zenoh would refuse, or
    without any user: Zenoh would then accept every connection."""
    found = dict[str, str]()
    for number, line in enumerate(readable_secret(path, "zenoh.users_file").splitlines(), 1):
        name, _, password = line.partition(":")
        if line.strip():
            if not name.strip() or not password.strip():
                raise ConfigError(
                    f"zenoh.users_file {path}, line {number}: write it as name:password"
                )
            found[name.strip()] = password.strip()
    if not found:
        raise ConfigError(
            f"zenoh.users_file {path} names no user, so the gateway would accept every connection"
        )
    return found


def holds_secret(zenoh_file: str) -> bool:
    """True if the text of a Zenoh file contains a password or a private key."""
    return _SECRET.search(zenoh_file) is not None
