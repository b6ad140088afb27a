"""Secrets and certificates of the ways to people, and what their servers answer."""

import smtplib
import ssl
from pathlib import Path

from gateway.contract.access.secrets import readable_secret
from gateway.errors import ConfigError, GatewayError
from gateway.transport.os_errors import sentence_of


def first_line(path: Path, way: str) -> str:
    """Returns a secret. Blocks."""
    try:
        return readable_secret(path, f"notify.{way}").partition("\n")[0].strip()
    except ConfigError as error:
        raise GatewayError(str(error)) from None


def trusted(ca: Path | None) -> ssl.SSLContext:
    """Raises `GatewayError`. Blocks."""
    try:
        return ssl.create_default_context(cafile=ca)
    except (OSError, ValueError) as error:
        raise GatewayError(f"{ca}: {said(error)}") from None


def said(error: Exception) -> str:
    """Returns one sentence. A server may answer anything."""
    if isinstance(error, smtplib.SMTPResponseException):
        reply = error.smtp_error
        said = reply.decode(errors="replace") if isinstance(reply, bytes) else reply
        text = f"the server answers {error.smtp_code} {said}"
    else:
        text = sentence_of(error) if isinstance(error, OSError) else str(error)
        text = text or type(error).__name__
    text = " ".join(text.split())
    return "".join(c if c.isprintable() else "?" for c in text)[:200]
