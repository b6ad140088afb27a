"""The connections of OPC UA clients: what asyncua leaves open is closed here.

asyncua takes any certificate, opens sessions without security, lets a client fill the memory, and
has one connection keep all others waiting. Each of these has its limit in this module.
"""

import asyncio
from contextlib import suppress
from typing import Any, cast

from asyncua import ua
from asyncua.common.connection import SecureConnection, TransportLimits
from asyncua.common.utils import Buffer, ServiceError
from asyncua.crypto.security_policies import SecurityPolicyNone
from asyncua.server import binary_server_asyncio, subscription_service
from asyncua.server.binary_server_asyncio import OPCUAProtocol
from asyncua.server.internal_session import InternalSession
from asyncua.server.uaprocessor import UaProcessor
from asyncua.ua.ua_binary import (
    nodeid_from_binary,
    struct_from_binary,
    uatcp_to_binary,
)

from gateway.bridges.opcua.admission import (
    MOST_CHUNK,
    MOST_CONNECTIONS,
    MOST_MESSAGE,
    MOST_OF_HOST,
    MOST_SESSIONS,
)
from gateway.bridges.opcua.items import Subscription
from gateway.bridges.opcua.sessions import Core, Session
from gateway.bridges.opcua.trust import Refused, check_uri, first_of_chain

Code = ua.StatusCodes
LIMITS = TransportLimits(MOST_CHUNK, MOST_CHUNK, MOST_MESSAGE // MOST_CHUNK + 1, MOST_MESSAGE)
UNREAD = 30.0  # seconds that a client may leave its answers unread
_KINDS = b"HEL", b"OPN", b"MSG", b"CLO", b"ERR"
PENDING = 50  # requests of one connection that wait before it is read no further
MOST_SLOW = 20  # writes and reads of the history of one connection at once
MOST_REST = 0.2  # seconds that a connection waits after a request that took long
MOST_PUBLISH = 30  # publish requests that wait


def _ids(*names: str) -> dict[ua.NodeId, str]:
    return {
        ua.NodeId(getattr(ua.ObjectIds, f"{name}Request_Encoding_DefaultBinary")): name
        for name in names
    }


_OPEN = _ids("FindServers", "GetEndpoints", "CreateSession", "ActivateSession", "CloseSession")
_SLOW = _ids("Write", "HistoryRead", "Call")  # they wait for a gateway
_OTHERS = _ids(
    *("Read", "Browse", "BrowseNext", "TranslateBrowsePathsToNodeIds"),
    *("RegisterNodes", "UnregisterNodes", "CloseSecureChannel"),
    *("CreateSubscription", "ModifySubscription", "DeleteSubscriptions", "TransferSubscriptions"),
    *("CreateMonitoredItems", "ModifyMonitoredItems", "DeleteMonitoredItems"),
    *("SetMonitoringMode", "SetPublishingMode", "Publish", "Republish"),
)
_SERVICES = _OPEN | _SLOW | _OTHERS  # asyncua has more, and serves some of them to anybody


class Channel(SecureConnection):
    """A secure channel. A client may send the certificates of its authorities, too."""

    def select_policy(
        self, uri: str, peer_certificate: bytes | None, mode: ua.MessageSecurityMode | None = None
    ) -> None:
        super().select_policy(uri, first_of_chain(peer_certificate), mode)


class Processor(UaProcessor):
    """Executes the requests of one connection."""

    iserver: Core
    session: Session | None

    def __init__(self, core: Core, transport: Any, limits: TransportLimits) -> None:
        super().__init__(core, transport, limits)
        self._connection: SecureConnection = Channel(SecurityPolicyNone(), self._limits)
        self._slow: set[asyncio.Task[bool]] = set()
        self.peer = str((transport.get_extra_info("peername") or ["?"])[0])

    @property
    def certificate(self) -> bytes | None:
        """The certificate of the client: it has proved that it has the key."""
        return self._connection.security_policy.peer_certificate or None

    @property
    def _is_plain(self) -> bool:
        return bool(self._connection.security_policy.Mode == ua.MessageSecurityMode.None_)

    async def process(self, header: ua.Header, body: Buffer) -> bool:
        try:
            return bool(await super().process(header, body))
        except Refused as refusal:
            code = refusal.code
        except ua.UaError:  # such as a policy that the server does not have
            code = Code.BadSecurityChecksFailed
        error = ua.ErrorMessage(ua.StatusCode(code), "")
        self._transport.write(uatcp_to_binary(ua.MessageType.Error, error))
        return False

    def open_secure_channel(self, algohdr: Any, seqhdr: Any, body: Buffer) -> None:
        if self._connection.security_policy.URI != SecurityPolicyNone.URI:
            self.iserver.admission.check(self.certificate, self.peer)
        super().open_secure_channel(algohdr, seqhdr, body)

    async def process_message(self, seqhdr: Any, body: Buffer) -> bool:
        """Lets a client go on while a write of its own waits for the device."""
        if nodeid_from_binary(body.copy()) not in _SLOW or len(self._slow) >= MOST_SLOW:
            return bool(await super().process_message(seqhdr, body))
        task = asyncio.create_task(super().process_message(seqhdr, body))
        self._slow.add(task)
        task.add_done_callback(self._slow.discard)
        return True

    async def _process_message(
        self, typeid: ua.NodeId, requesthdr: ua.RequestHeader, seqhdr: Any, body: Buffer
    ) -> bool:
        service = _SERVICES.get(typeid)
        if service is None:
            raise ServiceError(Code.BadServiceUnsupported)
        if service == "CreateSession":
            self._check_new(struct_from_binary(ua.CreateSessionParameters, body.copy()))
        elif service == "ActivateSession":
            self._check_own(requesthdr.AuthenticationToken)
        elif typeid not in _OPEN and service != "CloseSecureChannel":
            if self.session is None or requesthdr.AuthenticationToken != self.session.auth_token:
                raise ServiceError(Code.BadSessionIdInvalid)
            if not self.iserver.admission.is_known(self.session.user):
                raise ServiceError(Code.BadUserAccessDenied)
        if service == "BrowseNext":
            await self._browse_next(requesthdr, seqhdr, body)
            return True
        done = await super()._process_message(typeid, requesthdr, seqhdr, body)
        if service == "CreateSession" and self.session is not None:
            self.session.certificate = self.certificate
        if service in ("CreateSession", "ActivateSession") and self.session is not None:
            self.session.taken_by(self, self._transport)
        return bool(done)

    async def _browse_next(self, requesthdr: ua.RequestHeader, seqhdr: Any, body: Buffer) -> None:
        if self.session is None or not self.session.is_activated():
            raise ServiceError(Code.BadSessionNotActivated)
        params = struct_from_binary(ua.BrowseNextParameters, body)
        response = ua.BrowseNextResponse()
        response.Parameters.Results = await self.session.browse_next(params)
        self.send_response(requesthdr.RequestHandle, seqhdr, response)

    def _check_new(self, params: ua.CreateSessionParameters) -> None:
        """A session belongs to one connection, and to the application that opened its channel."""
        self._check_security()
        if self.session is not None and not self.session.is_closed():
            raise ServiceError(Code.BadTooManySessions)
        if self.iserver.is_full():
            self.iserver.admission.refused(f"a session of {self.peer}", "too many are open")
            raise ServiceError(Code.BadTooManySessions)
        if self.certificate is None:
            return
        if params.ClientCertificate and (
            first_of_chain(params.ClientCertificate) != self.certificate
        ):
            raise ServiceError(Code.BadSecurityChecksFailed)
        try:
            check_uri(self.certificate, params.ClientDescription.ApplicationUri or "")
        except Refused as refusal:
            self.iserver.admission.refused(f"a client at {self.peer}", str(refusal))
            raise ServiceError(refusal.code) from None

    def _check_own(self, token: ua.NodeId) -> None:
        """A client may go on with its session on a new connection: the same application only."""
        self._check_security()
        session = self.iserver.lookup_external_session(token)
        if session is None or (self.session is not None and self.session is not session):
            raise ServiceError(Code.BadSessionIdInvalid)
        if cast("Session", session).certificate != self.certificate:
            raise ServiceError(Code.BadSecurityChecksFailed)

    def _check_security(self) -> None:
        """Without this, a channel that is meant for discovery would open sessions, too."""
        if self._is_plain and not self.iserver.admission.plain:
            raise ServiceError(Code.BadSecurityModeRejected)

    def _should_close_session_on_transport_loss(self) -> bool:
        if self.session is not None and not self.session.is_of(self):
            return False  # it goes on elsewhere
        return bool(super()._should_close_session_on_transport_loss())

    def publish_request_limit(self, subscription_count: int) -> int:
        return min(subscription_count + 10, MOST_PUBLISH)


class Connection(OPCUAProtocol):
    """A TCP connection."""

    iserver: Core
    processor: Processor | None
    host = ""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.host = str((transport.get_extra_info("peername") or ["?"])[0])
        self._writable = asyncio.Event()
        self._writable.set()
        own = sum(isinstance(one, Connection) and one.host == self.host for one in self.clients)
        if own >= MOST_OF_HOST or len(self.clients) >= MOST_CONNECTIONS:
            self.iserver.admission.refused(f"a connection of {self.host}", "too many are open")
            cast("asyncio.Transport", transport).abort()
            return
        super().connection_made(transport)
        self.since = asyncio.get_running_loop().time()

    def abort(self) -> None:
        if self.transport is not None:
            self.transport.abort()

    def data_received(self, data: bytes) -> None:
        if self.iserver.admission.is_held():
            self.abort()  # a write in it may be old
            return
        super().data_received(data)
        if not _may_begin(self._buffer):
            self.abort()
        elif self.transport is not None and self.messages.qsize() > PENDING:
            self.transport.pause_reading()

    def pause_writing(self) -> None:
        self._writable.clear()

    def resume_writing(self) -> None:
        self._writable.set()

    async def _process_one_msg(self, header: ua.Header, buf: Buffer) -> bool:
        done, time = False, asyncio.get_running_loop().time
        try:
            async with asyncio.timeout(UNREAD):
                await self._writable.wait()
            begun = time()
            done = await super()._process_one_msg(header, buf)
        except TimeoutError:
            self.abort()
            return False
        finally:
            if not done and self.transport is not None:
                self.transport.close()
        if self.messages.empty() and self.transport is not None:
            with suppress(RuntimeError):  # it is closing
                self.transport.resume_reading()
        await asyncio.sleep(min(time() - begun, MOST_REST))  # half of the time is of the others
        return done

    def is_idle(self, now: float) -> bool:
        """True without a session for a time."""
        session = self.processor.session if self.processor is not None else None
        if session is not None and not session.is_closed():
            self.since = now
        return now - self.since > self.iserver.max_pending_activation_seconds


def _may_begin(data: bytes) -> bool:
    """True for the beginning of a message. asyncua waits for 4 GB, if that is what it announces."""
    size = int.from_bytes(data[4:8], "little")
    return not data or ((any(map(data.startswith, _KINDS)) or len(data) < 3) and size <= MOST_CHUNK)


def install() -> None:
    """asyncua names these classes in its modules, and has no other way to replace them."""
    subscription_service.InternalSubscription = Subscription
    binary_server_asyncio.UaProcessor = Processor
    binary_server_asyncio.OPCUAProtocol = Connection
    InternalSession.max_connections = MOST_SESSIONS + 1  # `Core.is_full` is asked before it
