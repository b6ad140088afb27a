"""Certificates and keys, checked before Zenoh opens: it reports errors late and briefly."""

import ssl
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from gateway import files
from gateway.config import Config, TlsConfig
from gateway.contract.access.secrets import closed_to_others
from gateway.contract.documents.state import CertificateDocument
from gateway.contract.faults import certificate_fault
from gateway.errors import ConfigError
from gateway.tags.timestamps import rfc3339
from gateway.transport.asn1 import after, element

DAY = 86_400
_UTC_TIME, _VERSION, _EXTENSIONS, _UTF8 = 0x17, 0xA0, 0xA3, 0x0C  # tags of ASN.1
# 1.3.6.1.4.1.50316.802.1, the extension of Modbus/TCP Security (V3.6, 8.2).
_ROLE = bytes.fromhex("2b060104018389 0c862201")


def check_files(tls: TlsConfig, section: str = "zenoh.tls") -> ssl.SSLContext:
    """Returns the context of a server with these files.

    Raises `ConfigError` for a file that is no certificate or no key, and for a key of another
    certificate.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    found = (("ca", tls.ca), ("certificate", tls.certificate), ("revoked", tls.revoked))
    for name, file in found:
        if file is not None:
            with _as_config_error(f"{section}.{name} {file}", "holds no certificate in PEM form"):
                context.load_verify_locations(file)
    if tls.certificate is not None and tls.key is not None:
        wrong = f"is no PEM key without a password, or not that of {tls.certificate}"
        with _as_config_error(f"{section}.key {tls.key}", wrong):
            context.load_cert_chain(tls.certificate, tls.key, password="")
    return context


def check(config: Config) -> list[str]:
    """Returns a sentence for each certificate of Zenoh and of lines that expires within 30 days.

    Raises `ConfigError` for files that are no certificate or key, or do not belong together.
    """
    found = []
    for section, tls in config.secured.items():
        if tls.key is not None:
            closed_to_others(tls.key, f"{section}.key")
        check_files(tls, section)
        for name, file in (("ca", tls.ca), ("certificate", tls.certificate)):
            if file is not None:
                at = expires(files.read(file, files.MOST_OF_SECRETS), last=name == "ca")
                found += [certificate_fault(f"{section}.{name}", document(file, at, time.time()))]
    return [one for one in found if one]


def document(file: Path, found: float | str, now: float) -> CertificateDocument:
    """Returns the status document of a certificate.

    `found`: when it expires, or why that is unknown. Times in seconds since 1970.
    """
    if isinstance(found, str):
        return {"file": str(file), "expires": None, "days": None, "trouble": found}
    at, days = rfc3339(int(found * 1e9)), round((found - now) / DAY, 1)
    return {"file": str(file), "expires": at, "days": days, "trouble": ""}


def expires(content: bytes, *, last: bool = False) -> float:
    """Returns when the first certificate of a PEM file expires, or the `last`: s since 1970.

    Raises `ConfigError` for other content.
    """
    begin, end = "-----BEGIN CERTIFICATE-----", "-----END CERTIFICATE-----"
    blocks = content.decode("ascii", "replace").split(begin)[1:]
    try:
        found = [
            _not_after(ssl.PEM_cert_to_DER_cert(f"{begin}{one.partition(end)[0]}{end}"))
            for one in blocks
        ]
    except (ValueError, IndexError):
        found = []
    if not found:
        raise ConfigError("it holds no certificate in PEM form")
    return max(found) if last else min(found)


def may_write(tls: TlsConfig, der: bytes) -> bool:
    """Returns False if the certificate of the other side has no role that may write."""
    return not tls.writers or role(der) in tls.writers


def role(der: bytes) -> str:
    """Returns the role of Modbus/TCP Security in a certificate; empty: it has none.

    Only that of the extension counts: a name may hold the same bytes.
    """
    try:
        _, certificate = element(der)
        _, fields = element(certificate)
        while fields[0] != _EXTENSIONS:
            fields = after(fields)
        _, listed = element(fields)
        _, rest = element(listed)
        while rest:
            _, extension = element(rest)
            rest = after(rest)
            if element(extension)[1] != _ROLE:
                continue
            while more := after(extension):  # a flag may stand before the value
                extension = more
            tag, text = element(element(extension)[1])
            return text.decode() if tag == _UTF8 else ""
    except (IndexError, UnicodeDecodeError):
        pass
    return ""


def _not_after(der: bytes) -> float:
    """RFC 5280, 4.1: version, serial number, algorithm, issuer, then the validity."""
    _, certificate = element(der)
    _, fields = element(certificate)
    if fields[0] == _VERSION:
        fields = after(fields)
    for _ in ("serial number", "algorithm", "issuer"):
        fields = after(fields)
    _, validity = element(fields)
    tag, time_of = element(after(validity))
    form = "%y%m%d%H%M%SZ" if tag == _UTC_TIME else "%Y%m%d%H%M%SZ"
    return datetime.strptime(time_of.decode(), form).replace(tzinfo=UTC).timestamp()


@contextmanager
def _as_config_error(called: str, wrong: str) -> Iterator[None]:
    try:
        yield
    except ssl.SSLError:
        raise ConfigError(f"{called} {wrong}") from None
    except OSError as error:
        raise ConfigError(f"{called}: {error.strerror}") from None
