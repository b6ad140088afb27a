"""Certificates and keys, checked before Zenoh opens: it reports errors late and briefly."""

import ssl
from collections.abc import Iterator
from contextlib import contextmanager

from gateway.config import TlsConfig
from gateway.errors import ConfigError


def check_files(tls: TlsConfig) -> None:
    """Raises `ConfigError` for a file that is no certificate or no key, and for a key of another
    certificate."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    for name, file in (("ca", tls.ca), ("certificate", tls.certificate)):
        if file is not None:
            with _as_config_error(f"zenoh.tls.{name} {file}", "holds no certificate in PEM form"):
                context.load_verify_locations(file)
    if tls.certificate is not None and tls.key is not None:
        wrong = f"is no PEM key without a password, or not that of {tls.certificate}"
        with _as_config_error(f"zenoh.tls.key {tls.key}", wrong):
            context.load_cert_chain(tls.certificate, tls.key, password="")


@contextmanager
def _as_config_error(called: str, wrong: str) -> Iterator[None]:
    try:
        yield
    except ssl.SSLError:
        raise ConfigError(f"{called} {wrong}") from None
    except OSError as error:
        raise ConfigError(f"{called}: {error.strerror}") from None
