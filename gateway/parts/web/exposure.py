"""Checks the settings of the HTTP side, without opening anything."""

from gateway.config import Config
from gateway.contract.access.named_secrets import NamedSecrets
from gateway.parts.web.settings import WebSection


def check(config: Config) -> list[str]:
    """Returns warnings, as sentences. Raises `ConfigError` for a bad tokens file."""
    web = config.part(WebSection)
    if web is None:
        return []
    if web.tokens_file is not None:
        NamedSecrets(web.tokens_file, "web.tokens_file")
    if web.is_local:
        return []
    warning = (
        f"other machines can reach web.listen {web.host}:{web.port}: each request needs a token, "
        "but tokens and values are not encrypted; see docs/page.md"
    )
    return [warning]
