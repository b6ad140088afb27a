"""Watches the certificates of Zenoh, lines and doors: an expired one ends their connections."""

import asyncio
import hashlib
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from gateway import files
from gateway.config import Config, TlsConfig
from gateway.contract.access.certificates import check_files, document, expires
from gateway.errors import ConfigError
from gateway.plant.part import Core, Kind, Phase
from gateway.plant.threads import off_loop
from gateway.tags import Tag

_ZENOH = "zenoh.tls"
LOOK_EVERY = 3600.0  # seconds
LOOK_WITHIN = 4.0  # seconds: a file system may hang


@dataclass(frozen=True, slots=True)
class Looked:
    """The files as they were seen."""

    content: bytes  # a digest of all of them
    found: Mapping[
        str, tuple[Path, float | str]
    ]  # by setting: expires at, s since 1970; or why not
    trouble: str  # what makes Zenoh refuse them together


class CertificatePart:
    """The files of `zenoh.tls`, of lines and of doors.

    Zenoh reads them for each connection that it opens, but only once for those that it accepts: a
    gateway that listens starts over with renewed files, when they are sound. Lines and doors read
    theirs again by themselves.
    """

    def __init__(self, core: Core) -> None:
        self._core = core
        self._secured = core.config.secured
        zenoh = core.config.zenoh
        self._listens = zenoh.config_file is not None or any(
            endpoint.startswith(("tls/", "quic/")) for endpoint in zenoh.listen
        )
        self._opened_with: bytes | None = None
        self._looked = Looked(b"", {}, "")

    async def begin(self) -> None:
        self._looked = await off_loop(_look, self._secured, within=LOOK_WITHIN)
        self._opened_with = self._looked.content

    async def run(self) -> None:
        while True:
            await asyncio.sleep(LOOK_EVERY)
            await self._look_again()

    async def take_over(self, config: Config, _renewed: Mapping[Tag, Tag]) -> None:
        """A reload looks at the files at once."""
        self._secured = config.secured
        await self._look_again()

    async def _look_again(self) -> None:
        self._looked = found = await off_loop(_look, self._secured, within=LOOK_WITHIN)
        if self._listens and found.content != self._opened_with and not found.trouble:
            self._core.start_over("the files of zenoh.tls were renewed")

    def documents(self) -> Mapping[str, Mapping[str, object]]:
        now = time.time()
        return {
            f"certificates/{setting.removeprefix(_ZENOH + '.')}": document(file, found, now)
            for setting, (file, found) in self._looked.found.items()
        }


def _look(secured: Mapping[str, TlsConfig]) -> Looked:
    """Reads the files. Blocks."""
    digest, found = hashlib.sha256(), dict[str, tuple[Path, float | str]]()
    for section, tls in secured.items():
        for name, path in (("ca", tls.ca), ("certificate", tls.certificate), ("key", tls.key)):
            if path is None:
                continue
            try:
                content = files.read(path, files.MOST_OF_SECRETS)
                if section == _ZENOH:
                    digest.update(content)
                if name != "key":
                    found[f"{section}.{name}"] = path, expires(content, last=name == "ca")
            except OSError as error:
                found[f"{section}.{name}"] = path, str(error.strerror)
            except ConfigError as error:
                found[f"{section}.{name}"] = path, str(error)
    try:
        if (zenoh := secured.get(_ZENOH)) is not None:
            check_files(zenoh)
    except ConfigError as error:
        return Looked(digest.digest(), found, str(error))
    return Looked(digest.digest(), found, "")


KIND = Kind(CertificatePart, Phase.SHOWING)
