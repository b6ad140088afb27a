"""An authority of the tests' own: certificates that are good, expired, revoked, for other names."""

from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
)
from cryptography.x509.oid import NameOID, ObjectIdentifier

# Modbus/TCP Security V3.6, 8.2: the extension that holds the role, a UTF8String.
ROLE = "1.3.6.1.4.1.50316.802.1"
DAY = timedelta(days=1)


def _name(text: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])


class Authority:
    """Writes `ca.pem`, and certificates with their keys beside it."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        self.ca = folder / "ca.pem"
        self._key = ec.generate_private_key(ec.SECP256R1())
        self._subject = _name("plant")
        self._write(self.ca, self._built(self._subject, self._key, self._key, 10 * DAY, ()))

    def issue(
        self,
        name: str,
        *,
        names: tuple[str, ...] = ("localhost", "127.0.0.1"),
        left: timedelta = 10 * DAY,
        role: str | None = None,
        oid: str = ROLE,
        self_signed: bool = False,
    ) -> tuple[Path, Path]:
        """Returns certificate and key. `left`: from now to its end."""
        key = ec.generate_private_key(ec.SECP256R1())
        signs = key if self_signed else self._key
        extensions: list[x509.ExtensionType] = [
            x509.SubjectAlternativeName([_general(one) for one in names])
        ]
        if role is not None:  # DER: UTF8String
            value = bytes((0x0C, len(role))) + role.encode()
            extensions.append(x509.UnrecognizedExtension(ObjectIdentifier(oid), value))
        built = self._built(_name(name), key, signs, left, extensions, self_signed=self_signed)
        certificate, secret = self.folder / f"{name}.pem", self.folder / f"{name}.key"
        self._write(certificate, built)
        made = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
        secret.write_bytes(made)
        secret.chmod(0o600)
        return certificate, secret

    def revoke(self, *certificates: Path, left: timedelta = DAY) -> Path:
        """Returns the list of revoked certificates."""
        now = datetime.now(UTC)
        builder = x509.CertificateRevocationListBuilder().issuer_name(self._subject)
        builder = builder.last_update(now - 2 * DAY).next_update(now + left)
        for one in certificates:
            found = x509.load_pem_x509_certificate(one.read_bytes())
            entry = x509.RevokedCertificateBuilder().serial_number(found.serial_number)
            builder = builder.add_revoked_certificate(entry.revocation_date(now - DAY).build())
        path = self.folder / "revoked.pem"
        path.write_bytes(builder.sign(self._key, hashes.SHA256()).public_bytes(Encoding.PEM))
        return path

    def _built(
        self,
        subject: x509.Name,
        key: ec.EllipticCurvePrivateKey,
        signs: ec.EllipticCurvePrivateKey,
        left: timedelta,
        extensions: "tuple[()] | list[x509.ExtensionType]",
        *,
        self_signed: bool = False,
    ) -> x509.Certificate:
        ends = datetime.now(UTC) + left
        builder = x509.CertificateBuilder().subject_name(subject).public_key(key.public_key())
        builder = builder.issuer_name(subject if self_signed else self._subject)
        builder = builder.serial_number(x509.random_serial_number())
        builder = builder.not_valid_before(ends - 20 * DAY).not_valid_after(ends)
        builder = builder.add_extension(
            x509.BasicConstraints(ca=not extensions, path_length=None), critical=True
        )
        for one in extensions:
            builder = builder.add_extension(one, critical=False)
        return builder.sign(signs, hashes.SHA256())

    @staticmethod
    def _write(path: Path, certificate: x509.Certificate) -> None:
        path.write_bytes(certificate.public_bytes(Encoding.PEM))


def _general(text: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ip_address(text))
    except ValueError:
        return x509.DNSName(text)
