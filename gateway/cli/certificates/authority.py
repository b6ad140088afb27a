"""The authority of a folder: invites, signs, renews and revokes.

The folder has the key of the plant: only its owner may read it.
"""

import hmac
import re
import time
from pathlib import Path

from gateway.cli.certificates import signing
from gateway.cli.certificates.code import Code, new_secret
from gateway.cli.certificates.signing import Holder, Pair
from gateway.cli.certificates.state import Entry, Invitation, State, changing, keep, load, read
from gateway.config.settings.parsers import web_address
from gateway.contract.access.secrets import closed_to_others
from gateway.errors import ConfigError, NotAllowed

AUTHORITY_DAYS, SERVER, REVOKED = 3650, "server", "revoked.pem"
WAITS = 5.0  # seconds for another command
MOST_NAMES = 10_000
MOST_SERIALS = 50  # of a name: each after two thirds of the life of the one before
_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,63}\Z")
_TAKEN = {"ca", SERVER, "revoked", "authority"}  # names of files in the folder


def create(folder: Path, days: int, at: str = "") -> Path:
    """Makes an authority, and returns its certificate. `at`: where gateways reach it; empty: that
    is not known yet. Raises `GatewayError`."""
    if at:
        web_address(at)
    certificate, key = folder / "ca.pem", folder / "ca.key"
    if key.exists() or certificate.exists():
        raise ConfigError(f"{folder} has an authority: its certificates would end with it")
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder}: {error.strerror}") from None
    made = signing.new_authority(days)
    keep(key, signing.pem_of_key(made.key))
    keep(certificate, signing.pem(made.certificate))
    if at:
        with changing(folder) as state:
            state.at = at
    return certificate


class Authority:
    """The authority of a folder. Blocks: it reads and writes files."""

    def __init__(self, folder: Path) -> None:
        """Raises `ConfigError` for a folder without a sound authority."""
        self.folder = folder
        certificate, key = folder / "ca.pem", folder / "ca.key"
        if not key.exists():
            raise ConfigError(f"there is no {key}: first run plc-gateway ca create {folder}")
        closed_to_others(key, "the key of the authority")
        self._own = Pair(
            signing.certificate_of(read(certificate)), signing.private_key_of(read(key))
        )
        if self._own.certificate.public_key() != self._own.key.public_key():
            raise ConfigError(f"{key} is not the key of {certificate}")

    @property
    def certificate(self) -> bytes:
        return signing.pem(self._own.certificate)

    @property
    def fingerprint(self) -> str:
        return signing.fingerprint(self._own.certificate)

    # -- people --

    def serve_at(self, at: str) -> None:
        """Keeps the address, and makes a certificate for it. Raises `GatewayError`."""
        with changing(self.folder) as state:
            state.at = at
            holder = Holder(SERVER, [at.rpartition(":")[0].strip("[]")])
            key = signing.new_key()
            made = signing.signed(self._own, holder, key.public_key(), AUTHORITY_DAYS)
            keep(self.folder / f"{SERVER}.key", signing.pem_of_key(key))
            keep(self.folder / f"{SERVER}.pem", signing.pem(made))

    def invite(self, holder: Holder, days: float, within: float) -> Code:
        """Returns a code that is good once, for `within` seconds. Raises `GatewayError`."""
        with changing(self.folder) as state:
            if not state.at:
                raise ConfigError(
                    "gateways must know where to enrol: start "
                    f"plc-gateway ca serve {self.folder} --at ca.plant:8444"
                )
            self._enter(state, holder, days)
            secret = new_secret()
            state.invitations[holder.name] = Invitation(secret=secret, until=time.time() + within)
            return Code(holder.name, state.at, secret, self.fingerprint)

    def issue(self, holder: Holder, days: float) -> Path:
        """Makes key and certificate here, and returns the certificate. Raises `GatewayError`."""
        file, key = self.folder / f"{holder.name}.pem", signing.new_key()
        with changing(self.folder) as state:
            entry = self._enter(state, holder, days)
            made = self._signed(entry, holder, key.public_key())
            entry.is_revoked = False
            state.invitations.pop(holder.name, None)
            keep(self.folder / f"{holder.name}.key", signing.pem_of_key(key))
            keep(file, made)
        return file

    def revoke(self, name: str) -> Entry:
        """Revokes all certificates of a name, and its code. Raises `GatewayError`."""
        with changing(self.folder) as state:
            entry = state.names.get(name)
            if entry is None:
                known = ", ".join(sorted(state.names)[:20]) or "none"
                raise ConfigError(f"{name} has no certificate here; known: {known}")
            entry.is_revoked = True
            state.invitations.pop(name, None)
            state.revoked |= dict.fromkeys(entry.serials, time.time())
            serials = ((int(serial, 16), at) for serial, at in state.revoked.items())
            keep(self.folder / REVOKED, signing.revoked(self._own, serials))
            return entry

    def state(self) -> State:
        """Raises `ConfigError`."""
        return load(self.folder)

    # -- programs --

    def enrol(self, name: str, secret: str, request: bytes) -> bytes:
        """Returns the certificate for the request of a newcomer. Raises `NotAllowed`, and
        `GatewayError` for what is not the newcomer's fault."""
        key = signing.key_of_request(request)
        with changing(self.folder) as state:
            found = state.invitations.get(name)
            if found is None or not hmac.compare_digest(found.secret.encode(), secret.encode()):
                raise NotAllowed("this code is not known, or has expired: invite again")
            entry, used_by = state.names[name], signing.digest(key)
            if found.used_by == used_by:
                return entry.latest.encode()
            if found.used_by:
                raise NotAllowed("this code was used by another program: revoke its name")
            made = self._signed(entry, _holder(name, entry), key)
            found.used_by, entry.is_revoked = used_by, False
            return made

    def renew(self, present: bytes, request: bytes) -> bytes:
        """Returns a new certificate for the same key: who has the key signs the request.

        Early in its life the latest certificate is returned again. Raises as `enrol`.
        """
        key, old = signing.key_of_request(request), signing.certificate_of(present)
        name, serial = signing.name_of(old), _serial(old)
        if not signing.is_issued_by(old, self._own.certificate) or old.public_key() != key:
            raise NotAllowed("this certificate is of another authority, or of another key")
        with changing(self.folder) as state:
            entry = state.names.get(name)
            if entry is None or entry.is_revoked or serial in state.revoked:
                raise NotAllowed(f"the certificate of {name} is revoked")
            latest = signing.certificate_of(entry.latest.encode())
            if serial not in entry.serials or latest.public_key() != key:
                raise NotAllowed(f"{name} has enrolled again with another key")
            if time.time() > old.not_valid_after_utc.timestamp():
                raise NotAllowed(f"the certificate of {name} has ended: invite it again")
            if not signing.is_due(latest):
                return entry.latest.encode()
            return self._signed(entry, _holder(name, entry), key)

    # -- inside --

    def _enter(self, state: State, holder: Holder, days: float) -> Entry:
        """Returns the entry of a name, with what it shall have from now on."""
        if not _NAME.match(holder.name) or holder.name in _TAKEN:
            raise ConfigError(
                f"{holder.name} is no name here: use up to 64 letters, digits, . _ -, and none of "
                + ", ".join(sorted(_TAKEN))
            )
        for one in holder.addresses:
            signing.address(one)
        old = state.names.get(holder.name)
        if old is None and len(state.names) >= MOST_NAMES:
            raise ConfigError(f"{self.folder} has {MOST_NAMES} names: create another authority")
        entry = old or Entry(addresses=[], is_client=False, days=days)
        entry.addresses, entry.is_client = [*holder.addresses], holder.is_client
        entry.days = days
        state.names[holder.name] = entry
        return entry

    def _signed(self, entry: Entry, holder: Holder, key: signing.PublicKey) -> bytes:
        made = signing.signed(self._own, holder, key, entry.days)
        ends = made.not_valid_after_utc.timestamp()
        entry.serials = dict([*entry.serials.items(), (_serial(made), ends)][-MOST_SERIALS:])
        entry.latest = signing.pem(made).decode()
        return signing.pem(made)


def _holder(name: str, entry: Entry) -> Holder:
    return Holder(name, entry.addresses, entry.is_client)


def _serial(certificate: signing.Certificate) -> str:
    return f"{certificate.serial_number:x}"
