"""The newcomer's side: a key that stays here, and its certificate from the authority.

The key is on disk before the authority hears of it, and the same code and key get the same answer:
a newcomer that was killed, or has a full disk, begins again with the same code.
"""

import json
import ssl
from collections.abc import Mapping
from datetime import UTC, datetime
from http import HTTPStatus
from http.client import HTTPException, HTTPSConnection
from pathlib import Path
from typing import NamedTuple

from pydantic import BaseModel, ValidationError

from gateway.cli.certificates import signing
from gateway.cli.certificates.authority import REVOKED
from gateway.cli.certificates.code import Code
from gateway.cli.certificates.state import keep, read
from gateway.config.settings.parsers import web_address
from gateway.contract.access.secrets import closed_to_others
from gateway.errors import ConfigError, GatewayError, words_of

WITHIN = 15.0  # seconds for each step of a connection
MOST_BYTES = 2**20
_PLACE = "enrolment.json"


class Enrolled(BaseModel):
    """The place of a gateway at its authority. `at`: host and port."""

    name: str
    at: str


class Files(NamedTuple):
    """The files of a gateway that has enrolled."""

    ca: Path
    certificate: Path
    key: Path


def enrol(folder: Path, code: Code) -> Files:
    """Returns the files, made in the folder. Raises `GatewayError`."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder}: {error.strerror}") from None
    found, place = files(folder, code.name), folder / _PLACE
    if place.exists() and enrolled(folder).name != code.name:
        raise ConfigError(f"{folder} is of {enrolled(folder).name}: choose another --folder")
    authority = _authority(code)
    key = _key(found.key)
    keep(found.ca, signing.pem(authority))
    keep(place, Enrolled(name=code.name, at=code.at).model_dump_json().encode())
    sent = {
        "name": code.name,
        "secret": code.secret,
        "request": signing.request_for(code.name, key).decode(),
    }
    made = _asked(code.at, _context(found.ca), "/enrol", sent)
    _take(found, made, key)
    return found


def renew(folder: Path) -> tuple[Files, bool]:
    """Returns the files, and True if the certificate is a new one. Raises `GatewayError`.

    The key stays, so that only one file changes: there is no moment without a pair. Takes the list
    of revoked certificates too.
    """
    place = enrolled(folder)
    found = files(folder, place.name)
    closed_to_others(found.key, "the key")
    context, before = _context(found.ca), read(found.certificate)
    is_new = False
    if signing.is_due(signing.certificate_of(before)):
        key = signing.private_key_of(read(found.key))
        sent = {
            "certificate": before.decode(),
            "request": signing.request_for(place.name, key).decode(),
        }
        made = _asked(place.at, context, "/renew", sent)
        _take(found, made, key)
        is_new = made != before
    if revoked := _asked(place.at, context, f"/{REVOKED}"):
        keep(folder / REVOKED, revoked)
    return found, is_new


def files(folder: Path, name: str) -> Files:
    return Files(folder / "ca.pem", folder / f"{name}.pem", folder / f"{name}.key")


def enrolled(folder: Path) -> Enrolled:
    """Raises `ConfigError`."""
    place = folder / _PLACE
    if not place.exists():
        raise ConfigError(f"{folder} has not enrolled: run plc-gateway enrol with a code first")
    try:
        return Enrolled.model_validate_json(read(place))
    except ValidationError:
        raise ConfigError(f"{place} is damaged: enrol again with a code") from None


def _authority(code: Code) -> signing.Certificate:
    """Returns the certificate of the authority that made the code, and of no other. Raises
    `GatewayError`."""
    unknown = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    unknown.check_hostname, unknown.verify_mode = False, ssl.CERT_NONE
    found = signing.certificate_of(_asked(code.at, unknown, "/ca.pem"))
    if signing.fingerprint(found) != code.fingerprint:
        raise GatewayError(
            f"{code.at} is another authority than that of the code: nothing was sent to it"
        )
    return found


def _key(file: Path) -> signing.PrivateKey:
    """Returns the key of this gateway, and makes it first if there is none."""
    if file.exists():
        closed_to_others(file, "the key")
        return signing.private_key_of(read(file))
    key = signing.new_key()
    keep(file, signing.pem_of_key(key))
    return key


def _take(found: Files, made: bytes, key: signing.PrivateKey) -> None:
    """Puts a certificate into its place. Raises `GatewayError` for one that is not good now."""
    certificate = signing.certificate_of(made)
    authority = signing.certificate_of(read(found.ca))
    if certificate.public_key() != key.public_key() or not signing.is_issued_by(
        certificate, authority
    ):
        raise GatewayError("the authority sent a certificate that is not for this key")
    begin, end = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    if not begin <= datetime.now(UTC) <= end:
        raise GatewayError(
            f"the certificate is valid from {begin:%Y-%m-%d %H:%M} to {end:%Y-%m-%d %H:%M} UTC, "
            "and not now: set the clocks of this computer and of the authority"
        )
    keep(found.certificate, made)


def _context(ca: Path) -> ssl.SSLContext:
    try:
        return ssl.create_default_context(cafile=ca)
    except (ssl.SSLError, OSError) as error:
        raise ConfigError(f"{ca} cannot be used: {words_of(error)}") from None


def _asked(
    at: str, context: ssl.SSLContext, path: str, sent: Mapping[str, str] | None = None
) -> bytes:
    """Returns the answer of the authority; empty: it has no such file. Raises `GatewayError`."""
    connection = HTTPSConnection(*web_address(at), timeout=WITHIN, context=context)
    try:
        if sent is None:
            connection.request("GET", path)
        else:
            connection.request("POST", path, json.dumps(sent))
        reply = connection.getresponse()
        data = reply.read(MOST_BYTES)
    except ssl.SSLCertVerificationError as error:
        why = f"{at} cannot be trusted: {error.verify_message}; is a clock wrong?"
        raise GatewayError(why) from None
    except (OSError, HTTPException) as error:
        raise GatewayError(f"the authority {at} does not answer: {words_of(error)}") from None
    finally:
        connection.close()
    if reply.status == HTTPStatus.OK:
        return data
    if reply.status == HTTPStatus.NOT_FOUND and sent is None:
        return b""
    try:
        why = str(json.loads(data)["error"])
    except (ValueError, KeyError, TypeError):
        why = f"{reply.status} {reply.reason}"
    raise GatewayError(f"the authority {at} refuses: {why[:300]}")
