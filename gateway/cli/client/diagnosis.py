"""Finds the cause of a failed connection: Zenoh reports only that it failed."""

import json
import socket
import ssl
from collections.abc import Sequence

import zenoh

_CONNECT_TIMEOUT = 2.0  # seconds
_ANSWER_WITHIN = 3.0  # seconds
_NO_MESSAGE = b"\x01\x00\xff"  # Zenoh closes the link at once
_STANDS_STILL = "takes connections and does not answer: that process stands still"
_TLS = "transport/link/tls"


def connection_failure(
    setup: zenoh.Config, endpoints: Sequence[str], user: str | None, hint: str
) -> str:
    """Returns a sentence for each endpoint that accepts connections; empty if none does.

    `hint` explains how to give a user name, for a client without one (`user` is None).
    """
    refused = f"refuses the user {user}: the name or password is wrong"
    if user is None:
        refused = f"requires a name and password: {hint}"
    sentences = [
        f"{endpoint} {fault or refused}"
        for endpoint in endpoints
        if (fault := _fault(endpoint, setup)) is not None
    ]
    return "; ".join(sentences)


def _fault(endpoint: str, setup: zenoh.Config) -> str | None:
    """Returns what is wrong, "" for nothing, None when the endpoint is closed."""
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.partition("?")[0].partition("#")[0].rpartition(":")
    host = host.strip("[]")
    if protocol not in ("tcp", "tls"):
        return None  # cannot be tested here
    try:
        link = socket.create_connection((host, int(port)), _CONNECT_TIMEOUT)
    except OSError:
        return None
    with link:
        link.settimeout(_ANSWER_WITHIN)
        return _tls_fault(link, host, setup) if protocol == "tls" else _silence(link)


def _silence(link: socket.socket) -> str:
    """Returns a sentence if no answer comes, not even the end of the link."""
    try:
        link.sendall(_NO_MESSAGE)
        link.recv(1)
    except TimeoutError:
        return _STANDS_STILL
    except OSError:  # closed
        pass
    return ""


def _tls_fault(link: socket.socket, host: str, setup: zenoh.Config) -> str:
    try:
        with _context(setup).wrap_socket(link, server_hostname=host):
            return ""
    except TimeoutError:
        return _STANDS_STILL
    except ssl.SSLCertVerificationError as error:
        return f"has an untrusted certificate: {error.verify_message}"
    except ssl.SSLError as error:
        return f"fails the TLS handshake: {error.reason}"
    except OSError:  # closed
        return ""


def _context(setup: zenoh.Config) -> ssl.SSLContext:
    """Returns a context with the trust and the certificate of the Zenoh configuration."""

    def setting(name: str) -> object:
        found: object = json.loads(setup.get_json(f"{_TLS}/{name}"))
        return found

    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = setting("verify_name_on_connect") is not False
    if isinstance(authority := setting("root_ca_certificate"), str):
        context.load_verify_locations(authority)
    elif setting("root_ca_certificate_base64") is None:
        context.load_default_certs()
    else:
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    match setting("connect_certificate"), setting("connect_private_key"):
        case str(certificate), str(key):
            context.load_cert_chain(certificate, key)
    return context
