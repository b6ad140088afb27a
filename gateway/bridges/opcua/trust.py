"""The certificates of the OPC UA server: its own, and the folder of clients that it trusts.

The folder has `own/` (certificate and key), `trusted/` and `rejected/`. A client is trusted if its
own certificate is in `trusted/`, whoever signed it. The certificate of an unknown client is put
into `rejected/`: a person compares its thumbprint and moves it.
"""

import hashlib
import os
import re
import socket
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from ipaddress import ip_address
from pathlib import Path

from asyncua import ua
from asyncua.crypto import cert_gen
from cryptography import x509
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import rsa
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from gateway import files
from gateway.contract.access.secrets import closed_to_others
from gateway.errors import ConfigError, NotAllowed

MOST_FILES = 200  # of trusted clients, and of rejected ones
LARGEST = 16_384  # bytes of a certificate
SMALLEST_KEY = 2048  # bits, of the policy Basic256Sha256
VALID_DAYS = 5 * 365  # of a certificate that is made here

Code = ua.StatusCodes


class Refused(NotAllowed):
    """A client whose certificate is not accepted. `code`: the status code for the client."""

    def __init__(self, code: int, why: str) -> None:
        super().__init__(why)
        self.code = code


class Own:
    """The certificate and the key of the server. Raises `ConfigError` for bad ones."""

    def __init__(self, certificate: Path, key: Path) -> None:
        self._files = certificate, key
        self._version: object = None
        self.certificate: x509.Certificate
        self.key: rsa.RSAPrivateKey
        self.renewed()

    def renewed(self) -> bool:
        """Reads the files again, if they changed. They are taken over together or not at all."""
        certificate_file, key_file = self._files
        try:
            version = [(found.st_mtime_ns, found.st_ino) for found in map(os.stat, self._files)]
            if version == self._version:
                return False
            closed_to_others(key_file, "the key")
            certificate = _certificate(files.read(certificate_file, files.MOST_OF_SECRETS))
            key = _key(files.read(key_file, files.MOST_OF_SECRETS))
        except OSError as error:
            raise ConfigError(f"{error.filename}: {error.strerror}") from None
        except (TypeError, ValueError):
            pair = f"{certificate_file} and {key_file}"
            raise ConfigError(f"{pair} are no certificate and key without a password") from None
        if not isinstance(key, rsa.RSAPrivateKey) or key.key_size < SMALLEST_KEY:
            raise ConfigError(f"{key_file} is no RSA key of {SMALLEST_KEY} bits or more")
        if key.public_key() != certificate.public_key():
            raise ConfigError(f"{key_file} is not the key of {certificate_file}")
        self.certificate, self.key, self._version = certificate, key, version
        return True

    @property
    def uri(self) -> str:
        """The application URI; empty where the certificate has none: clients would refuse it."""
        return next(iter(uris(self.certificate)), "")

    @property
    def der(self) -> bytes:
        return self.certificate.public_bytes(serialization.Encoding.DER)

    def days_left(self) -> float:
        return (self.certificate.not_valid_after_utc - datetime.now(UTC)).total_seconds() / 86_400


def make_own(folder: Path, uri: str, host: str) -> tuple[Path, Path, bool]:
    """Returns the files of the certificate and of its key, and True if they were made now.

    `host`: the address that clients connect to, besides the names of this machine. Raises
    `ConfigError`.
    """
    certificate_file, key_file = folder / "own" / "certificate.der", folder / "own" / "key.pem"
    if certificate_file.exists() and key_file.exists():
        return certificate_file, key_file, False
    names = {socket.gethostname(), "localhost", host}
    names -= {"", "0.0.0.0", "::"}
    key = cert_gen.generate_private_key()
    made = cert_gen.generate_self_signed_app_certificate(
        key,
        "plc-gateway OPC UA",
        {},
        [x509.UniformResourceIdentifier(uri), *map(_name, sorted(names))],
        [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH],
        VALID_DAYS,
    )
    try:
        key_file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with open(key_file, "wb", opener=lambda path, flags: os.open(path, flags, 0o600)) as file:
            file.write(cert_gen.dump_private_key_as_pem(key))
        certificate_file.write_bytes(made.public_bytes(serialization.Encoding.DER))
    except OSError as error:
        raise ConfigError(
            f"no certificate can be made: {error.filename}: {error.strerror}"
        ) from None
    return certificate_file, key_file, True


class TrustList:
    """The clients that may connect. `load` and `keep_rejected` do I/O, on a thread."""

    def __init__(self, folder: Path) -> None:
        """Raises `ConfigError` if the folders cannot be made."""
        self._trusted, self._rejected = folder / "trusted", folder / "rejected"
        self._known: Mapping[bytes, str] = {}  # file names by certificate
        self._unknown: dict[bytes, Path] = {}  # waiting for the disk
        try:
            for place in (self._trusted, self._rejected):
                place.mkdir(mode=0o700, parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"{error.filename}: {error.strerror}") from None
        self.trouble = ""
        self.load()

    def load(self) -> None:
        """Reads the folder again. `trouble` has a sentence for what cannot be read."""
        trouble = []
        known = dict[bytes, str]()
        try:
            found = sorted(self._trusted.iterdir())
        except OSError as error:
            found = []
            trouble.append(f"{self._trusted}: {error.strerror}: no client is trusted")
        for file in found[:MOST_FILES]:
            try:
                certificate = _certificate(files.read(file, LARGEST))
                known[certificate.public_bytes(serialization.Encoding.DER)] = file.name
            except (OSError, ValueError):
                trouble.append(f"{file} is no certificate")
        if len(found) > MOST_FILES:
            trouble.append(f"{self._trusted} has more than {MOST_FILES} files: some are ignored")
        self._known, self.trouble = known, "; ".join(trouble)

    def check(self, sent: bytes | None, now: datetime) -> None:
        """Raises `Refused` for a certificate that is not accepted (now)."""
        if sent is None or len(sent) > LARGEST:
            raise Refused(Code.BadCertificateInvalid, "it sent no certificate")
        certificate = _certificate(sent)
        called = f"the certificate of {name_of(certificate)}"
        if sent not in self._known:
            raise Refused(Code.BadSecurityChecksFailed, f"{called} is not trusted")
        key = certificate.public_key()
        if not isinstance(key, rsa.RSAPublicKey) or key.key_size < SMALLEST_KEY:
            why = f"{called} has no RSA key of {SMALLEST_KEY} bits or more"
            raise Refused(Code.BadCertificatePolicyCheckFailed, why)
        if now > certificate.not_valid_after_utc:
            why = f"{called} expired on {certificate.not_valid_after_utc:%Y-%m-%d}"
            raise Refused(Code.BadCertificateTimeInvalid, why)
        if now < certificate.not_valid_before_utc:
            why = f"{called} is not valid before {certificate.not_valid_before_utc:%Y-%m-%d %H:%M}"
            raise Refused(Code.BadCertificateTimeInvalid, f"{why} UTC: is a clock wrong?")

    def reject(self, sent: bytes) -> Path | None:
        """Returns the file that `keep_rejected` will make of an untrusted certificate; None: too
        many wait."""
        mark = hashlib.sha1(sent, usedforsecurity=False).hexdigest()  # as OPC UA clients show it
        called = re.sub(r"[^\w.@-]+", "_", name_of(_certificate(sent)))[:60]
        if len(self._unknown) >= MOST_FILES:
            return None
        return self._unknown.setdefault(sent, self._rejected / f"{called}-{mark}.der")

    def keep_rejected(self) -> Iterator[str]:
        """Yields a sentence for each certificate that cannot be kept. Raises `OSError`."""
        while self._unknown:
            sent, file = self._unknown.popitem()
            if file.exists():
                continue
            if len(list(self._rejected.iterdir())) >= MOST_FILES:
                yield f"{self._rejected} is full: delete the files of clients that you do not know"
                return
            file.write_bytes(sent)


def check_uri(sent: bytes, uri: str) -> None:
    """Raises `Refused` if a client calls itself by another URI than its certificate."""
    certificate = _certificate(sent)
    if uri not in uris(certificate):
        why = f"the certificate of {name_of(certificate)} is not for the application {uri[:100]!r}"
        raise Refused(Code.BadCertificateUriInvalid, why)


def uris(certificate: x509.Certificate) -> list[str]:
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except (x509.ExtensionNotFound, x509.DuplicateExtension, ValueError):
        return []
    return names.get_values_for_type(x509.UniformResourceIdentifier)


def name_of(certificate: x509.Certificate) -> str:
    """Returns the common name, without characters that could forge a line of the log."""
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    text = "".join(filter(str.isprintable, str(names[0].value)[:80])) if names else ""
    return text or "a client without a name"


def first_of_chain(sent: bytes | None) -> bytes | None:
    """Returns the client's own certificate: those of its authorities may follow it."""
    if sent is None or len(sent) < 4 or sent[1] != 0x82:  # an element of 256 to 65,535 bytes
        return sent
    return sent[: 4 + int.from_bytes(sent[2:4], "big")]


def _certificate(data: bytes) -> x509.Certificate:
    """Raises ValueError."""
    if data.lstrip().startswith(b"-----"):
        return x509.load_pem_x509_certificate(data)
    return x509.load_der_x509_certificate(data)


def _key(data: bytes) -> object:
    if data.lstrip().startswith(b"-----"):
        return serialization.load_pem_private_key(data, None)
    return serialization.load_der_private_key(data, None)


def _name(name: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ip_address(name))
    except ValueError:
        return x509.DNSName(name)
