"""Certificates of a plant: its authority, those that it signs, the list of revoked ones."""

import hashlib
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from typing import NamedTuple, TypeGuard

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from gateway.config.settings.parsers import host_name
from gateway.errors import ConfigError

Certificate = x509.Certificate
PublicKey = ec.EllipticCurvePublicKey
PrivateKey = ec.EllipticCurvePrivateKey
BEFORE = timedelta(hours=1)  # a certificate is valid before it was made: clocks differ
_PEM = serialization.Encoding.PEM
_OWN = ("localhost", "127.0.0.1", "::1")  # every gateway is valid for them


def _called(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


_AUTHORITY = _called("plant authority")


class Holder(NamedTuple):
    """The owner of a certificate. `addresses`: at which clients reach it. `is_client`: it connects,
    and no program connects to it."""

    name: str
    addresses: Sequence[str] = ()
    is_client: bool = False


class Pair(NamedTuple):
    """A certificate and its key."""

    certificate: x509.Certificate
    key: PrivateKey


def new_key() -> PrivateKey:
    return ec.generate_private_key(ec.SECP256R1())


def new_authority(days: int) -> Pair:
    """Returns the certificate of an authority, which signs gateways and no other authority."""
    key, now = new_key(), datetime.now(UTC)
    made = (
        _begun(_AUTHORITY, _AUTHORITY, key.public_key(), key.public_key())
        .not_valid_before(now - BEFORE)
        .not_valid_after(now + timedelta(days=days))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(signs=True), critical=True)
    )
    return Pair(made.sign(key, hashes.SHA256()), key)


def signed(authority: Pair, holder: Holder, key: PublicKey, days: float) -> x509.Certificate:
    """Returns a certificate for the holder. Raises `ConfigError` where the authority has ended.

    Nothing of a request is in it but the public key.
    """
    now, last = datetime.now(UTC), authority.certificate.not_valid_after_utc
    if now >= last:
        raise ConfigError(f"the authority ended on {last:%Y-%m-%d}: create another one")
    uses = [] if holder.is_client else [ExtendedKeyUsageOID.SERVER_AUTH]
    uses.append(ExtendedKeyUsageOID.CLIENT_AUTH)
    names = [*map(address, dict.fromkeys((*holder.addresses, *_OWN)))]
    if holder.is_client:
        names = [x509.DNSName(holder.name)]
    made = (
        _begun(_called(holder.name), authority.certificate.subject, key, authority.key.public_key())
        .not_valid_before(now - BEFORE)
        .not_valid_after(min(now + timedelta(days=days), last))
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(signs=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(uses), critical=False)
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
    )
    return made.sign(authority.key, hashes.SHA256())


def revoked(authority: Pair, serials: Iterable[tuple[int, float]]) -> bytes:
    """Returns the list of revoked certificates in PEM form, from serial numbers and times in s
    since 1970. It ends with the authority: OpenSSL refuses every connection with an old list."""
    now = datetime.now(UTC)
    made = (
        x509.CertificateRevocationListBuilder()
        .issuer_name(authority.certificate.subject)
        .last_update(now - BEFORE)
        .next_update(authority.certificate.not_valid_after_utc)
    )
    for serial, at in serials:
        one = x509.RevokedCertificateBuilder().serial_number(serial)
        made = made.add_revoked_certificate(
            one.revocation_date(datetime.fromtimestamp(at, UTC)).build()
        )
    return made.sign(authority.key, hashes.SHA256()).public_bytes(_PEM)


def request_for(name: str, key: PrivateKey) -> bytes:
    """Returns the request for a certificate, in PEM form. The key signs it."""
    made = x509.CertificateSigningRequestBuilder().subject_name(_called(name))
    return made.sign(key, hashes.SHA256()).public_bytes(_PEM)


def key_of_request(pem: bytes) -> PublicKey:
    """Returns the public key of a request whose sender has the private one.

    Raises `ConfigError`.
    """
    try:
        request = x509.load_pem_x509_csr(pem)
        key = request.public_key()
        if request.is_signature_valid and _is_p256(key):
            return key
    except (ValueError, UnsupportedAlgorithm, InvalidSignature):
        pass
    raise ConfigError("this is no request for a certificate with a P-256 key, signed by that key")


def is_issued_by(certificate: x509.Certificate, authority: x509.Certificate) -> bool:
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature):
        return False
    return True


def is_due(certificate: Certificate) -> bool:
    """Returns True in the last third of its life, and before it: a clock was wrong."""
    begin, end = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    return not begin <= datetime.now(UTC) <= end - (end - begin) / 3


def certificate_of(pem: bytes) -> x509.Certificate:
    """Raises `ConfigError`."""
    try:
        return x509.load_pem_x509_certificate(pem)
    except ValueError:
        raise ConfigError("this is no certificate in PEM form") from None


def private_key_of(pem: bytes) -> PrivateKey:
    """Raises `ConfigError`."""
    try:
        key = serialization.load_pem_private_key(pem, None)
    except (ValueError, TypeError, UnsupportedAlgorithm):
        key = None
    if isinstance(key, ec.EllipticCurvePrivateKey) and isinstance(key.curve, ec.SECP256R1):
        return key
    raise ConfigError("this is no P-256 key in PEM form without a password")


def pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(_PEM)


def pem_of_key(key: PrivateKey) -> bytes:
    plain = serialization.NoEncryption()
    return key.private_bytes(_PEM, serialization.PrivateFormat.PKCS8, plain)


def fingerprint(certificate: x509.Certificate) -> str:
    return certificate.fingerprint(hashes.SHA256()).hex()


def digest(key: PublicKey) -> str:
    der = serialization.PublicFormat.SubjectPublicKeyInfo
    return hashlib.sha256(key.public_bytes(serialization.Encoding.DER, der)).hexdigest()


def name_of(certificate: x509.Certificate) -> str:
    """Returns the common name; empty: there is none."""
    found = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(found[0].value) if found else ""


def address(text: str) -> x509.GeneralName:
    """Raises `ConfigError` for text that is no IP address and no host name."""
    try:
        return x509.IPAddress(ip_address(text))
    except ValueError:
        return x509.DNSName(host_name(text))


def _begun(
    name: x509.Name,
    issuer: x509.Name,
    key: PublicKey,
    issuer_key: PublicKey,
) -> x509.CertificateBuilder:
    authority = x509.AuthorityKeyIdentifier.from_issuer_public_key(issuer_key)
    return (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
        .add_extension(authority, critical=False)
    )


def _usage(*, signs: bool) -> x509.KeyUsage:
    """`signs`: certificates, and nothing else."""
    return x509.KeyUsage(
        digital_signature=not signs,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs,
        crl_sign=signs,
        encipher_only=False,
        decipher_only=False,
    )


def _is_p256(key: object) -> TypeGuard[ec.EllipticCurvePublicKey]:
    return isinstance(key, ec.EllipticCurvePublicKey) and isinstance(key.curve, ec.SECP256R1)
