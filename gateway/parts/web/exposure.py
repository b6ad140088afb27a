"""Checks the settings and files of the HTTP side, without opening anything."""

from typing import TYPE_CHECKING

from gateway.config import Config, TlsConfig
from gateway.contract.access.named_secrets import NamedSecrets
from gateway.contract.access.secrets import closed_to_others
from gateway.parts.web.settings import WebSection, WebTlsSection

if TYPE_CHECKING:
    import ssl


def context(tls: WebTlsSection) -> "ssl.SSLContext":
    """Returns the context of the server. Blocks. Raises `ConfigError` for a bad file."""
    from gateway.contract.access.certificates import check_files  # its TLS takes 10 ms

    closed_to_others(tls.key, "web.tls.key")
    return check_files(TlsConfig(certificate=tls.certificate, key=tls.key), "web.tls")


def check(config: Config) -> list[str]:
    """Returns warnings, as sentences. Raises `ConfigError` for a bad tokens file or
    certificate."""
    web = config.part(WebSection)
    if web is None:
        return []
    if web.tokens_file is not None:
        NamedSecrets(web.tokens_file, "web.tokens_file")
    if web.tls is not None:
        context(web.tls)
    if web.is_local or web.tls is not None:
        return []
    warning = (
        f"other machines can reach web.listen {web.host}:{web.port}: each request needs a token, "
        "but tokens and values are not encrypted; see docs/page.md"
    )
    return [warning]
