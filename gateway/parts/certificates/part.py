"""Watches the certificates of Zenoh: an expired one closes the plant to all its clients."""

import asyncio
import hashlib
import time
from collections.abc import Mapping
from dataclasses import dataclass

from gateway import files
from gateway.config import Config, TlsConfig
from gateway.contract.access.certificates import check_files, document, expires
from gateway.errors import ConfigError
from gateway.plant.part import Core, Kind, Part, Phase
from gateway.plant.threads import off_loop
from gateway.tags import Tag

LOOK_EVERY = 3600.0  # seconds
LOOK_WITHIN = 4.0  # seconds: a file system may hang


@dataclass(frozen=True, slots=True)
class Looked:
    """The files as they were seen."""

    content: bytes  # a digest of all of them
    expires: Mapping[str, float | str]  # seconds since 1970 by setting; or why it is unknown
    trouble: str  # what makes Zenoh refuse them together


class CertificatePart:
    """The files of `zenoh.tls`. Zenoh reads them when its session opens: with renewed files the
    gateway starts over, when they are sound."""

    def __init__(self, core: Core, tls: TlsConfig) -> None:
        self._core = core
        self._tls = tls
        self._opened_with: bytes | None = None
        self._looked = Looked(b"", {}, "")

    async def begin(self) -> None:
        self._looked = await off_loop(_look, self._tls, within=LOOK_WITHIN)
        self._opened_with = self._looked.content

    async def run(self) -> None:
        while True:
            await asyncio.sleep(LOOK_EVERY)
            await self._look_again()

    async def take_over(self, _config: Config, _renewed: Mapping[Tag, Tag]) -> None:
        """A reload looks at the files at once."""
        await self._look_again()

    async def _look_again(self) -> None:
        self._looked = found = await off_loop(_look, self._tls, within=LOOK_WITHIN)
        if found.content != self._opened_with and not found.trouble:
            self._core.start_over("the files of zenoh.tls were renewed")

    def documents(self) -> Mapping[str, Mapping[str, object]]:
        now = time.time()
        return {
            f"certificates/{setting}": document(getattr(self._tls, setting), found, now)
            for setting, found in self._looked.expires.items()
        }


def _look(tls: TlsConfig) -> Looked:
    """Reads the files. Blocks."""
    digest, found = hashlib.sha256(), dict[str, float | str]()
    for setting, path in (("ca", tls.ca), ("certificate", tls.certificate), ("key", tls.key)):
        if path is None:
            continue
        try:
            content = files.read(path, files.MOST_OF_SECRETS)
            digest.update(content)
            if setting != "key":
                found[setting] = expires(content, last=setting == "ca")
        except OSError as error:
            found[setting] = str(error.strerror)
        except ConfigError as error:
            found[setting] = str(error)
    try:
        check_files(tls)
    except ConfigError as error:
        return Looked(digest.digest(), found, str(error))
    return Looked(digest.digest(), found, "")


def _make(core: Core) -> Part | None:
    tls = core.config.zenoh.tls
    return None if tls is None else CertificatePart(core, tls)


KIND = Kind(_make, Phase.SHOWING)
