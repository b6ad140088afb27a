"""The folder of an authority: its key, whom it invited, what it signed and revoked.

Several commands may use the folder at once: each change holds a lock, and is on disk before it is
answered. The folder has the key of the plant: only its owner may read it.
"""

import fcntl
import hmac
import os
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from pydantic import BaseModel, ValidationError

from gateway import files
from gateway.cli.certificates import signing
from gateway.cli.certificates.code import Code, new_secret
from gateway.cli.certificates.signing import Holder, Pair
from gateway.contract.access.secrets import closed_to_others
from gateway.errors import ConfigError, GatewayError, NotAllowed
from gateway.plant.saved_file import SavedFile

AUTHORITY_DAYS, SERVER, REVOKED = 3650, "server", "revoked.pem"
WAITS = 5.0  # seconds for another command
MOST_NAMES = 10_000
MOST_SERIALS = 50  # of a name: each after two thirds of the life of the one before
_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,63}\Z")
_TAKEN = {"ca", SERVER, "revoked", "authority"}  # names of files in the folder


class Invitation(BaseModel):
    """An open code. `until`: s since 1970. `used_by`: the digest of the key that used it; the same
    key may ask again, because the answer may be lost."""

    secret: str
    until: float
    used_by: str = ""


class Entry(BaseModel):
    """One name. `serials`: of its certificates, with their ends in s since 1970. `latest`: the last
    certificate, in PEM form; empty before the first."""

    addresses: list[str]
    is_client: bool
    days: float
    serials: dict[str, float] = {}
    latest: str = ""
    is_revoked: bool = False


class State(BaseModel):
    """What the authority remembers. `at`: host and port where it is reached. `revoked`: serial
    numbers with the time, s since 1970."""

    at: str = ""
    names: dict[str, Entry] = {}
    invitations: dict[str, Invitation] = {}
    revoked: dict[str, float] = {}


def create(folder: Path, days: int) -> Path:
    """Makes an authority, and returns its certificate. Raises `ConfigError`."""
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
        with self._changing() as state:
            state.at = at
            holder = Holder(SERVER, [at.rpartition(":")[0].strip("[]")])
            key = signing.new_key()
            made = signing.signed(self._own, holder, key.public_key(), AUTHORITY_DAYS)
            keep(self.folder / f"{SERVER}.key", signing.pem_of_key(key))
            keep(self.folder / f"{SERVER}.pem", signing.pem(made))

    def invite(self, holder: Holder, days: float, within: float) -> Code:
        """Returns a code that is good once, for `within` seconds. Raises `GatewayError`."""
        with self._changing() as state:
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
        with self._changing() as state:
            entry = self._enter(state, holder, days)
            made = self._signed(entry, holder, key.public_key())
            entry.is_revoked = False
            state.invitations.pop(holder.name, None)
            keep(self.folder / f"{holder.name}.key", signing.pem_of_key(key))
            keep(file, made)
        return file

    def revoke(self, name: str) -> Entry:
        """Revokes all certificates of a name, and its code. Raises `GatewayError`."""
        with self._changing() as state:
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
        """Raises `ConfigError`: without its memory an authority would forget whom it revoked."""
        file = self.folder / "authority.json"
        if not file.exists():
            return State()
        try:
            return State.model_validate_json(read(file))
        except ValidationError as error:
            what = f"{error.error_count()} mistakes"
            raise ConfigError(f"{file} is damaged ({what}): restore it from a backup") from None

    # -- programs --

    def enrol(self, name: str, secret: str, request: bytes) -> bytes:
        """Returns the certificate for the request of a newcomer. Raises `NotAllowed`, and
        `GatewayError` for what is not the newcomer's fault."""
        key = signing.key_of_request(request)
        with self._changing() as state:
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
        with self._changing() as state:
            entry = state.names.get(name)
            if entry is None or entry.is_revoked or serial in state.revoked:
                raise NotAllowed(f"the certificate of {name} is revoked")
            latest = signing.certificate_of(entry.latest.encode())
            if serial not in entry.serials or latest.public_key() != key:
                raise NotAllowed(f"{name} has enrolled again with another key")
            if time.time() > old.not_valid_after_utc.timestamp():
                raise NotAllowed(f"the certificate of {name} has ended: invite it again")
            if not is_due(latest):
                return entry.latest.encode()
            return self._signed(entry, _holder(name, entry), key)

    def sweep(self) -> None:
        """Forgets codes that have expired: a clock set back does not bring them back."""
        with self._changing():
            pass

    # -- inside --

    @contextmanager
    def _changing(self) -> Iterator[State]:
        """Yields the state, and keeps its changes, also if an error is raised. Raises
        `GatewayError`."""
        try:
            lock = os.open(self.folder / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise GatewayError(f"{self.folder}: {error.strerror}") from None
        try:
            self._take(lock)
            state = self.state()
            before = state.model_dump_json()
            now = time.time()
            for name, one in list(state.invitations.items()):
                if one.until < now:
                    del state.invitations[name]
            try:
                yield state
            finally:
                if state.model_dump_json() != before:
                    text = state.model_dump_json(indent=1)
                    keep(self.folder / "authority.json", text.encode())
        finally:
            os.close(lock)

    def _take(self, lock: int) -> None:
        """Raises `GatewayError` while another command holds the folder, which may stand still."""
        until = time.monotonic() + WAITS
        while True:
            try:
                return fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if time.monotonic() > until:
                    raise GatewayError(f"another command holds {self.folder}") from None
            time.sleep(0.02)

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


def is_due(certificate: signing.Certificate) -> bool:
    """Returns True in the last third of its life, and before it: a clock was wrong."""
    begin, end = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    return not begin <= datetime.now(UTC) <= end - (end - begin) / 3


def read(file: Path) -> bytes:
    """Raises `ConfigError`."""
    try:
        return files.read(file)
    except OSError as error:
        raise ConfigError(f"{file}: {error.strerror}") from None


def keep(file: Path, data: bytes) -> None:
    """Replaces a file, which only its owner can read. It is on disk when this returns.

    Raises `GatewayError`.
    """
    saved = SavedFile(file)
    saved.save(data)
    if saved.trouble:
        raise GatewayError(f"{file} cannot be written: {saved.trouble}")


def _holder(name: str, entry: Entry) -> Holder:
    return Holder(name, entry.addresses, entry.is_client)


def _serial(certificate: signing.Certificate) -> str:
    return f"{certificate.serial_number:x}"
