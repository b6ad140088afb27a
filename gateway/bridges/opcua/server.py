"""The OPC UA server: made, and looked after while it runs."""

import asyncio
import logging
import socket
from collections.abc import Sequence
from contextlib import AsyncExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlsplit

from asyncua import Server, ua

from gateway import __version__
from gateway.bridges.opcua import wire
from gateway.bridges.opcua.admission import MOST_CONNECTIONS, MOST_OPERATIONS, Admission, Quiet
from gateway.bridges.opcua.aggregates import NAMES
from gateway.bridges.opcua.bridge import Bridge
from gateway.bridges.opcua.browsing import MOST_POINTS
from gateway.bridges.opcua.history import History
from gateway.bridges.opcua.sessions import Core
from gateway.bridges.opcua.space import plant_into
from gateway.bridges.opcua.trust import Own, Refused, TrustList, make_own
from gateway.bridges.program import Gateways, opened, say
from gateway.contract.access.named_secrets import NamedSecrets
from gateway.errors import ConfigError

MODES = {
    "sign": ua.SecurityPolicyType.Basic256Sha256_Sign,
    "encrypt": ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt,
    "none": ua.SecurityPolicyType.NoSecurity,
}
LOOK_EVERY = 1.0  # seconds between two looks at the files and the clients
SOON = 30.0  # days until the certificate of the server expires
_LIMITS = "Server_ServerCapabilities_OperationLimits_MaxNodesPer"
_LIMIT_OF = {
    **dict.fromkeys(("Read", "Write", "Browse", "TranslateBrowsePathsToNodeIds"), MOST_OPERATIONS),
    **dict.fromkeys(("HistoryReadData", "MethodCall"), 100),
    **dict.fromkeys(("HistoryReadEvents", "NodeManagement"), 0),
}

_AGGREGATES = (
    ua.ObjectIds.Server_ServerCapabilities_AggregateFunctions,
    ua.ObjectIds.HistoryServerCapabilities_AggregateFunctions,
)
_HAS_HISTORY = ua.NodeId(ua.ObjectIds.HistoryServerCapabilities_AccessHistoryDataCapability)


class Options(NamedTuple):
    """The options of the command line.

    `security`: keys of `MODES`. `writers`: names; None: all users. `certificate` and
    `key` are made in the folder `pki` if they are not given.
    """

    listen: str
    pki: Path
    certificate: Path | None = None
    key: Path | None = None
    security: Sequence[str] = ("sign", "encrypt")
    users: Path | None = None
    writers: frozenset[str] | None = frozenset()
    anonymous: bool = False

    def check(self) -> str:
        """Returns the host that it listens on. Raises `ConfigError`."""
        try:
            found = urlsplit(self.listen)
            is_address = found.scheme == "opc.tcp" and found.hostname and found.port
        except ValueError:
            is_address = False
        if not is_address:
            raise ConfigError(f"--listen {self.listen}: write it as opc.tcp://127.0.0.1:4840")
        if unknown := set(self.security) - set(MODES):
            raise ConfigError(f"--security {', '.join(unknown)}: choose from {', '.join(MODES)}")
        if self.users is None and not self.anonymous:
            raise ConfigError(
                "nobody could log in: name a file of users with --users, or let everybody read "
                "with --anonymous"
            )
        if self.users is None and self.writers != frozenset():
            raise ConfigError("only users can write: name their file with --users")
        if (self.certificate is None) != (self.key is None):
            raise ConfigError("--certificate and --key belong together")
        return str(found.hostname)


async def bridge(gateways: Gateways, options: Options) -> None:
    """Serves the gateways until it is cancelled. Raises `ConfigError`."""
    host = options.check()
    users = None if options.users is None else NamedSecrets(options.users, "--users")
    own, trust = _security(gateways.prefix, options, host)
    writers = options.writers
    admission = Admission(
        trust,
        users,
        _Anybody() if writers is None else writers,
        options.anonymous,
        "none" in options.security,
    )
    _take_log(admission)
    wire.install()
    core = Core(admission)
    core.max_connections = MOST_CONNECTIONS
    server = Server(iserver=core)
    if own is not None:
        core.certificate, core.private_key = own.certificate, own.key
    await server.init()
    await server.set_application_uri(_uri(gateways.prefix) if own is None else own.uri)
    space = await _describe(server, options, gateways.prefix)
    async with AsyncExitStack() as stack:
        session = await opened(gateways)
        stack.enter_context(session)
        found = Bridge(session, gateways.prefix, space, core, admission)
        core.plant, core.history_manager = found, History(core, found.plant)
        plant_into(core.aspace, found.tree)
        try:
            await stack.enter_async_context(server)
        except OSError as error:
            raise ConfigError(f"--listen {options.listen}: {error.strerror}") from None
        say(f"listening on {options.listen}")
        async with asyncio.TaskGroup() as group:
            for part in found.parts():
                group.create_task(part)
            group.create_task(_look_after(server, core, found, own))


def _security(prefix: str, options: Options, host: str) -> tuple[Own | None, TrustList | None]:
    if set(options.security) == {"none"} and options.certificate is None:
        return None, None
    certificate, key = options.certificate, options.key
    if certificate is None or key is None:
        certificate, key, is_new = make_own(options.pki, _uri(prefix), host)
        if is_new:
            say(f"{certificate} was made: clients must trust it")
    own = Own(certificate, key)
    if not own.uri:
        raise ConfigError(f"{certificate} names no application URI: OPC UA clients refuse it")
    return own, TrustList(options.pki)


def _uri(prefix: str) -> str:
    return f"urn:{socket.gethostname()}:plc-gateway:{prefix}"


async def _describe(server: Server, options: Options, prefix: str) -> int:
    """Returns the index of the namespace of the tags."""
    server.set_endpoint(options.listen)
    server.set_server_name("plc-gateway")
    server.application_type = ua.ApplicationType.Server
    server.limits = wire.LIMITS
    server.set_security_policy([MODES[name] for name in dict.fromkeys(options.security)])
    tokens = [ua.AnonymousIdentityToken] if options.anonymous else []
    server.set_identity_tokens(
        [*tokens, ua.UserNameIdentityToken] if options.users is not None else tokens
    )
    now = datetime.now(UTC)
    await server.set_build_info(
        "urn:zenoh-plc-gateway", "zenoh-plc-gateway", "plc-gateway", __version__, "", now
    )
    for name, most in _LIMIT_OF.items():
        node = server.get_node(ua.NodeId(getattr(ua.ObjectIds, f"{_LIMITS}{name}")))
        await node.write_value(ua.Variant(most, ua.VariantType.UInt32))
    for aggregate in NAMES:
        for list_ in _AGGREGATES:
            await server.get_node(ua.NodeId(list_)).add_reference(aggregate, ua.ObjectIds.Organizes)
    await server.get_node(_HAS_HISTORY).write_value(True)
    points = ua.NodeId(ua.ObjectIds.Server_ServerCapabilities_MaxBrowseContinuationPoints)
    await server.get_node(points).write_value(ua.Variant(MOST_POINTS, ua.VariantType.UInt16))
    return int(await server.register_namespace(f"urn:zenoh-plc-gateway:{prefix}"))


async def _look_after(server: Server, core: Core, found: Bridge, own: Own | None) -> None:
    """Takes over changed files, and ends the connections of clients that may go on no longer."""
    admission, clock, told = core.admission, asyncio.get_running_loop().time, set[str]()
    while True:
        if admission.beat():
            say("this program was held: all clients must connect again")
            found.distrust()
            for one in list(server.bserver.clients):
                one.abort()
        for sentence in [*await asyncio.to_thread(_look, server, core, own), *_lost(found)]:
            if sentence not in told:
                say(sentence)
            told.add(sentence)
        now = datetime.now(UTC)
        for one in list(server.bserver.clients):
            if one.is_idle(clock()) or not _is_trusted(one.processor, admission, now):
                one.abort()
        for session in core.sessions():
            if session.is_activated() and not admission.is_known(session.user):
                say(f"the user {session.user.name} was withdrawn: its session ends")
                await session.end()
        await asyncio.sleep(LOOK_EVERY)


def _is_trusted(processor: wire.Processor, admission: Admission, now: datetime) -> bool:
    if admission.trust is None or processor.certificate is None:
        return True
    try:
        admission.trust.check(processor.certificate, now)
    except Refused as refusal:
        admission.refused(f"a client at {processor.peer}", f"{refusal} any more")
        return False
    return True


def _look(server: Server, core: Core, own: Own | None) -> list[str]:
    """Reads changed files, on a thread. Returns sentences for people."""
    said = []
    if (trust := core.admission.trust) is not None:
        try:
            trust.load()
            said += [*trust.keep_rejected(), trust.trouble]
        except OSError as error:
            said.append(f"{error.filename}: {error.strerror}")
    if own is not None:
        try:
            if own.renewed():
                _renew(server, core, own)
                said.append(f"the certificate of {own.certificate.not_valid_before_utc} counts now")
        except ConfigError as error:
            said.append(f"{error}: the certificate before is used")
        if (days := int(own.days_left())) < SOON:
            said.append(f"the certificate of this server expires in {days} days")
    return [sentence for sentence in said if sentence]


def _renew(server: Server, core: Core, own: Own) -> None:
    """New channels use the new certificate; those that are open go on."""
    core.certificate, core.private_key = own.certificate, own.key
    for policy in server._policies:
        policy.certificate, policy.private_key = own.certificate, own.key
    for endpoint in core.endpoints:
        endpoint.ServerCertificate = own.der


def _lost(found: Bridge) -> list[str]:
    lost, found.lost = found.lost, 0
    return (
        [f"{lost} changes came too fast for the clients: they have the last of each tag"]
        if (lost)
        else []
    )


class _Anybody(frozenset[str]):
    """Every user of the file."""

    def __contains__(self, _name: object) -> bool:
        return True


def _take_log(admission: Admission) -> None:
    log = logging.getLogger("asyncua")
    log.handlers, log.propagate = [Quiet(admission)], False
    log.setLevel(logging.ERROR)
