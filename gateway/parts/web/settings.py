"""The section `web` of the file."""

from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from gateway.config.settings.sections import PartSection, Place
from gateway.config.settings.session_model import Section
from gateway.config.settings.setting_types import FilePath, HostName, Text, WebAddress, WebOrigin
from gateway.contract.languages import Language
from gateway.transport.port import is_loopback, named


class WebTlsSection(Section):
    """HTTPS, with PEM files."""

    certificate: FilePath
    """The certificate of this machine, with those between it and its authority."""
    key: FilePath
    """The private key of the certificate; not readable by other users of this machine."""


class WebSection(Section):
    """The status page and /metrics."""

    listen: WebAddress = ("127.0.0.1", 8080)
    """The address of the page."""
    tokens_file: FilePath | None = None
    """One line `name:token` for each client; without it nothing can be written."""
    tls: WebTlsSection | None = None
    """The page over HTTPS."""
    overview: list[Text] = []
    """Tags that the page shows first, in this order: keys, also with *; left out: those with an
    alarm, a history or a unit."""
    language: Language | None = None
    """The language of the page, unless a person chooses another; left out: that of the browser."""
    fleet: bool | FilePath = False
    """Show all gateways under the prefix too; a folder: beside their files. See docs/fleet.md."""
    names: list[HostName] = []
    """Names of this machine in a browser's address, besides `localhost` and its host name."""
    origins: list[WebOrigin] = []
    """The origin of pages of an HMI that may use the gateway, such as https://hmi.plant."""

    @property
    def host(self) -> str:
        return self.listen[0]

    @property
    def port(self) -> int:
        return self.listen[1]

    @property
    def url(self) -> str:
        return f"{'http' if self.tls is None else 'https'}://{named(*self.listen)}/"

    @property
    def is_local(self) -> bool:
        """True if other machines cannot reach the address."""
        return is_loopback(self.host)


def _place(settings: WebSection | None, place: Place) -> WebSection | None:
    if settings is None:
        return None
    if settings.tokens_file is None and not settings.is_local:
        place.mistakes.at("web", "listen").add(
            f"other machines can reach {settings.host}: name a tokens_file too (see docs/page.md), "
            f"or listen on 127.0.0.1:{settings.port}"
        )
    for number, pattern in enumerate(settings.overview):
        if not any(fnmatchcase(tag.key, pattern) for tag in place.tags):
            place.mistakes.add(f"there is no tag {pattern}", "web", "overview", number)
    files: dict[str, Any] = {
        "tokens_file": place.existing(settings.tokens_file, "web", "tokens_file")
    }
    if (tls := settings.tls) is not None:
        found = {name: place.existing(file, "web", "tls", name) for name, file in dict(tls).items()}
        files["tls"] = tls.model_copy(update=found)
    if isinstance(settings.fleet, Path):
        files["fleet"] = place.folder / settings.fleet
        if not (place.mistakes.elsewhere or files["fleet"].is_dir()):
            place.mistakes.at("web", "fleet").add(
                f"{files['fleet']} is no folder: write true for none"
            )
    return settings.model_copy(update=files)


def _reads(settings: WebSection) -> list[tuple[str, Path | None]]:
    tls = {} if settings.tls is None else dict(settings.tls)
    return [
        ("web.tokens_file", settings.tokens_file),
        *((f"web.tls.{name}", file) for name, file in tls.items()),
    ]


SECTION = PartSection(name="web", settings=WebSection, place=_place, reads=_reads)
