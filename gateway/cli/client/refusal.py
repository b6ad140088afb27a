"""Why a gateway cannot be connected to: Zenoh itself says only that it cannot."""

import json
import socket
import ssl
from collections.abc import Sequence

import zenoh

_PATIENCE = 2.0  # seconds
_TLS = "transport/link/tls"


def why_not(setup: zenoh.Config, endpoints: Sequence[str], user: str | None, ways: str) -> str:
    """A sentence for each endpoint where somebody listens, or one for all where nobody does.

    `ways` is what somebody can do who gave no name, and `user` is None.
    """
    refused = f"does not let {user} in: a wrong name or password, or a gateway that is frozen"
    if user is None:
        refused = f"lets nobody in without name and password, or is frozen: {ways}"
    told = [
        f"{endpoint} {trouble or refused}"
        for endpoint in endpoints
        if (trouble := _met(endpoint, setup)) is not None
    ]
    if told:
        return "; ".join(told)
    return f"no gateway at {', '.join(endpoints)}: start it with `plc-gateway run`, or use --direct"


def _met(endpoint: str, setup: zenoh.Config) -> str | None:
    """What is wrong with the certificate there; "" if nothing is. None: nobody listens there."""
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.partition("?")[0].partition("#")[0].rpartition(":")
    host = host.strip("[]")
    if protocol not in ("tcp", "tls"):
        return None  # it cannot be looked at from here
    try:
        link = socket.create_connection((host, int(port)), _PATIENCE)
    except OSError:
        return None
    with link:
        return _certificate_trouble(link, host, setup) if protocol == "tls" else ""


def _certificate_trouble(link: socket.socket, host: str, setup: zenoh.Config) -> str:
    try:
        with _context(setup).wrap_socket(link, server_hostname=host):
            return ""
    except ssl.SSLCertVerificationError as error:
        return f"shows a certificate that is not believed: {error.verify_message}"
    except ssl.SSLError as error:
        return f"cannot be spoken to by TLS: {error.reason}"
    except OSError:  # silence, or hung up
        return ""


def _context(setup: zenoh.Config) -> ssl.SSLContext:
    """It believes what Zenoh believes, and shows what Zenoh shows."""

    def said(name: str) -> object:
        found: object = json.loads(setup.get_json(f"{_TLS}/{name}"))
        return found

    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = said("verify_name_on_connect") is not False
    if isinstance(authority := said("root_ca_certificate"), str):
        context.load_verify_locations(authority)
    elif said("root_ca_certificate_base64") is None:
        context.load_default_certs()
    else:
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    match said("connect_certificate"), said("connect_private_key"):
        case str(certificate), str(key):
            context.load_cert_chain(certificate, key)
    return context
