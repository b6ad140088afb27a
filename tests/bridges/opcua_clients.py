"""Certificates of OPC UA clients, made for a test."""

import ssl
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import rsa
from cryptography.x509.oid import NameOID

URI, NODE_URI = "urn:tests:client", "urn:tests:node"
TOKENS = {"ana": "ana-may-write-and-read-values", "ben": "ben-may-only-read-the-values"}
Encoding = serialization.Encoding


@cache
def key() -> rsa.RSAPrivateKey:
    return rsa.generate_private_key(65537, 2048)


@cache
def certificate(name: str, uri: str = URI, begins: int = -1, ends: int = 30) -> bytes:
    """Returns a certificate of the key. `begins`, `ends`: in so many days from now."""
    called = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    now = datetime.now(UTC)
    uris = x509.SubjectAlternativeName([x509.UniformResourceIdentifier(uri)])
    made = (
        x509.CertificateBuilder(called, called, key().public_key(), x509.random_serial_number())
        .not_valid_before(now + timedelta(days=begins))
        .not_valid_after(now + timedelta(days=ends))
        .add_extension(uris, critical=False)
        .sign(key(), hashes.SHA256())
    )
    return made.public_bytes(Encoding.DER)


def folder(path: Path) -> None:
    """Makes the folder of a server that trusts these clients, and the file of its users."""
    trusted = path / "pki" / "trusted"
    trusted.mkdir(parents=True)
    for name, made in {
        "scada": certificate("scada"),
        "expired": certificate("expired", begins=-20, ends=-2),
        "early": certificate("early", begins=2),
        "other": certificate("other", "urn:tests:other"),
        "node": certificate("node", NODE_URI),
    }.items():
        (trusted / f"{name}.der").write_bytes(made)
    form = serialization.PrivateFormat.PKCS8
    private = key().private_bytes(Encoding.PEM, form, serialization.NoEncryption())
    (path / "client.pem").write_bytes(private)
    (path / "client").mkdir()
    (path / "client" / "key.pem").write_bytes(private)
    pem = ssl.DER_cert_to_PEM_cert(certificate("node", NODE_URI))
    (path / "client" / "certificate.pem").write_text(pem)
    users = path / "users.txt"
    users.write_text("".join(f"{name}:{token}\n" for name, token in TOKENS.items()))
    users.chmod(0o600)
