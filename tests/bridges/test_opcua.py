"""`bridge opcua` with npm's OPC UA client: codes, times, writes, history."""

import asyncio
import json
import signal
import socket
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from asyncua import Client, ua
from asyncua.common.utils import Buffer
from asyncua.crypto import uacrypto
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
from asyncua.ua.ua_binary import struct_from_binary

from tests.bridges.conftest import INTEROP, bridge
from tests.bridges.opcua_clients import TOKENS, URI, certificate, folder
from tests.bridges.played import PlayedGateway
from tests.e2e.processes import Program, free_port, started, until, vigor_line, write_config
from tests.zenoh_peer import free_endpoint

TAGS: dict[str, dict[str, Any]] = {
    "mixer/speed": {"type": "float64", "unit": "rpm", "description": "of the drum"},
    "mixer/recipe": {"write": {"min": 1, "max": 40, "verify": False}},
    "mixer/alarms/door": {"type": "bool"},
    "mixer/name": {"type": "string[8]"},
    "mixer/steps": {"type": "uint16[3]", "length": 3, "write": {"verify": False}},
    "mixer/level": {"type": "float64", "write": {"verify": False}},
}


Code = ua.StatusCodes


class Plant(NamedTuple):
    endpoint: str  # of Zenoh, where the gateway listens
    gateway: PlayedGateway
    server: Program
    url: str
    folder: Path
    client: Program

    def ask(self, command: str, *words: object) -> Any:
        """Executes a command of tests/interop/opcua_client.js."""
        return json.loads(self.client.tell(" ".join([command, *map(str, words)])))

    def status(self, key: str) -> str:
        return str(self.ask("read", node(key))["status"])

    @asynccontextmanager
    async def connected(
        self, user: str | None = "ana", token: str | None = None, **security: Any
    ) -> AsyncIterator[Client]:
        """Connects asyncua's client."""
        client = await self.unconnected(user, token, **security)
        async with client:
            yield client

    async def unconnected(
        self,
        user: str | None = "ana",
        token: str | None = None,
        certificate: bytes | None = None,
        uri: str = URI,
        mode: ua.MessageSecurityMode = ua.MessageSecurityMode.SignAndEncrypt,
    ) -> Client:
        # Its watchdog would drop the connection when a test uses another token.
        client = Client(self.url, timeout=60, watchdog_intervall=60)
        client.application_uri = uri
        if user is not None:
            client.set_user(user)
            client.set_password(token or TOKENS.get(user, "no-token-of-this-server-at-all"))
        trusted = (self.folder / "pki" / "trusted" / "scada.der").read_bytes()
        await client.set_security(
            SecurityPolicyBasic256Sha256,
            uacrypto.CertProperties(certificate or trusted, "DER"),
            self.folder / "client.pem",
            mode=mode,
        )
        client.application_uri = uri
        return client


def node(key: str) -> str:
    return f"ns=2;s={key}"


@pytest.fixture(scope="module")
def plant(node: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plant]:
    endpoint, url = free_endpoint(), f"opc.tcp://127.0.0.1:{free_port()}"
    path = tmp_path_factory.mktemp("opcua")
    folder(path)
    pki, users = path / "pki", path / "users.txt"
    options = ("--listen", url, "--pki", pki, "--users", users, "--writer", "ana")
    with (
        PlayedGateway(endpoint, TAGS) as gateway,
        bridge("opcua", "--connect", endpoint, *options) as server,
        Program(node, INTEROP / "opcua_client.js", path / "client") as client,
    ):
        found = Plant(endpoint, gateway, server, url, path, client)
        server.says("listening")
        assert found.ask("connect", url, "SignAndEncrypt", "ana", TOKENS["ana"]) is None
        yield found
    assert "Traceback" not in "\n".join(server.lines)


def test_an_opc_ua_client_sees_no_good_value_and_no_write_that_is_not(plant: Plant) -> None:
    gateway = plant.gateway
    until(lambda: plant.status("mixer/name") == "BadWaitingForInitialData", "it has all tags")
    assert plant.ask("browse", "ns=2;s=/mixer/alarms/") == [node("mixer/alarms/door")]
    plant.ask("watch", node("mixer/speed"))

    gateway.put("mixer/speed", 12.5)
    plant.client.says("changed", "mixer/speed Good 12.5")
    for reason, code in {
        "no-reply": "BadDeviceFailure",
        "line-down": "BadNotConnected",
        "overdue": "BadResourceUnavailable",
        "new-reason": "Bad",
    }.items():
        gateway.put("mixer/speed", None, reason)
        plant.client.says("changed", f"mixer/speed {code} null")
    gateway.put("mixer/recipe", 70_000)  # more than its type
    gateway.put("mixer/name", "AB")
    until(lambda: plant.status("mixer/name") == "Good", "the name is read")
    assert plant.status("mixer/recipe") == "BadTypeMismatch"

    gateway.put("mixer/steps", [1, 2, 65535])
    until(lambda: plant.status("mixer/steps") == "Good", "the array is read")
    steps = plant.ask("read", node("mixer/steps"))
    assert (steps["value"], steps["type"]) == ([1, 2, 65535], "UInt16")

    # Nothing is written but by the gateway.
    write = ("write", node("mixer/recipe"), "Int16")
    assert plant.ask(*write, 7) == "Good"
    assert plant.ask("write", node("mixer/speed"), "Double", 1) == "BadNotWritable"
    assert plant.ask("write", node("mixer/none"), "Double", 1) == "BadNotWritable"
    assert plant.ask("write", node("mixer/recipe"), "Double", 1) == "BadTypeMismatch"
    assert plant.ask("write", node("mixer/recipe"), "Int16", "[7]") == "BadTypeMismatch"
    assert plant.ask("write", node("mixer/steps"), "UInt16", 7) == "BadTypeMismatch"
    assert plant.ask("write", node("mixer/steps"), "UInt16", "[3,2,1]") == "Good"
    for outcome, code in {
        "refused": "BadInvalidState",
        "line-down": "BadNotConnected",
        "unclear": "BadTimeout",
        "silent": "BadTimeout",
        "new-outcome": "BadTimeout",
    }.items():
        gateway.answer = outcome
        assert plant.ask(*write, 8) == code
    assert [value for _, value in gateway.written] == [7, [3, 2, 1], 8, 8, 8, 8, 8]
    assert plant.status("mixer/recipe") == "BadTypeMismatch"

    # The client reads on while its write waits.
    gateway.answer = "held"
    gateway.put("mixer/speed", 13.5)
    plant.ask("start", *write[1:], 9)
    gateway.until_written(8)
    assert plant.ask("read", node("mixer/speed"))["value"] == 13.5
    gateway.close()
    assert plant.ask("written") == "BadTimeout"
    plant.client.says("changed", "mixer/speed BadNoCommunication null")
    assert plant.status("mixer/alarms/door") == "BadNoCommunication"


def test_an_opc_ua_client_reads_a_gateway_and_its_history(plant: Plant, tmp_path: Path) -> None:
    tags = {
        "speed": {"address": "D100", "scale": 0.1, "unit": "rpm", "every": "50ms", "history": True},
        "recipe": {
            "address": "D500",
            "write": {"min": 1, "max": 40, "verify": True},
            "alarm": {"high": 30, "priority": "high"},
        },
    }
    file = write_config(
        tmp_path / "c.yaml",
        plant.endpoint,
        {"hall": vigor_line("simulator", tags, use=["press", "line/hall"])},
        templates={"press": {"retries": 1}, "line/hall": {"verify_reads": 1}},
        history={"path": "history.db"},
        writers={"file": str(plant.folder / "users.txt")},
    )
    speed, recipe = node("mixer/speed"), node("mixer/recipe")
    plant.gateway.close()
    with started(file) as gateway:
        until(lambda: plant.status("mixer/recipe") == "GoodEdited", "a value is simulated")
        folder = "ns=2;s=/@templates/"
        until(lambda: len(plant.ask("browse", folder)) == 2, "it has the templates")
        assert plant.ask("browse", f"{folder}line/") == [f"{folder}line/hall/"]
        for template in ("press/", "line/hall/"):
            assert plant.ask("browse", folder + template) == [node("/mixer/")]
        meta = plant.ask("meta", speed)
        assert (meta["type"], meta["access"], meta["unit"]) == ("Double", 5, "rpm")
        assert plant.ask("meta", recipe)["range"] == [1, 40]
        # In its first second a gateway takes no signature.
        until(lambda: plant.ask("write", recipe, "Int16", 7) == "Good", "it takes writes")
        assert plant.ask("write", recipe, "Int16", 41) == "BadOutOfRange"
        until(lambda: plant.ask("read", recipe)["value"] == 7, "the written value is read")
        assert gateway.says("tag written", "value=7", "by=ana")
        _alarm_is_acknowledged(plant)

        until(lambda: len(plant.ask("history", speed, 60, 0)["values"]) > 8, "there is history")
        whole = plant.ask("history", speed, 60, 3)["values"]
        back = plant.ask("history", speed, 60, 3, "back")["values"]
        assert whole[0]["status"] == "BadWaitingForInitialData"
        assert [known["status"] for known in whole].count("GoodEdited") > 3
        times = [known["time"] for known in whole]
        assert sorted(set(times)) == times
        assert back[::-1][: len(whole)] == whole
        last = plant.ask("history", speed, 0, 3, "last")["values"]
        assert last[::-1][: len(whole)] == whole
        assert plant.ask("history", recipe, 60, 0) == {"status": "BadHistoryOperationUnsupported"}

        _aggregates_are_those_of_the_values(plant, whole)

        gateway.end(signal.SIGKILL)
        until(lambda: plant.status("mixer/speed") == "BadNoCommunication", "it is bad")
        assert plant.ask("history", speed, 60, 0) == {"status": "BadNoCommunication"}
        assert plant.ask("write", recipe, "Int16", 8) == "BadNoCommunication"


def _aggregates_are_those_of_the_values(plant: Plant, raw: list[dict[str, Any]]) -> None:
    """Each aggregate of intervals of 300 ms, calculated here from the raw values."""
    good = [(_ms(one["time"]), one["value"]) for one in raw if one["status"] == "GoodEdited"]
    first, end = int(good[0][0]) + 1, int(good[-1][0]) - 1  # inside: the first one is valid
    # The client has milliseconds: no sample is so near to an end of an interval.
    start = next(
        start
        for start in range(first, first + 300)
        if all(2 <= (at - start) % 300 <= 298 for at, _ in good[1:-1])
    )
    expected = [_expected(good, at, min(at + 300, end)) for at in range(start, end, 300)]
    assert len(expected) > 1
    for name in expected[0]:
        found = plant.ask("aggregate", node("mixer/speed"), name, _iso(start), _iso(end), 300)
        assert [_ms(one["time"]) for one in found] == [*range(start, end, 300)]
        for one, wanted in zip(found, expected, strict=True):
            if wanted[name] is None:
                assert one["status"] == "BadNoData"
            else:
                rounded = 0.01 + (wanted["Range2"] or 0) / 100  # the client has milliseconds
                assert one["value"] == pytest.approx(wanted[name], abs=rounded), (name, one)
                assert one["status"].startswith("Good")
    ask = "aggregate", node("mixer/speed")
    assert plant.ask(*ask, "Total", _iso(start), _iso(end), 300) == {
        "status": "BadAggregateNotSupported"
    }
    assert plant.ask(*ask, "Count", _iso(end), _iso(start), 300) == {"status": "BadInvalidArgument"}
    functions = plant.ask("browse", "i=11201")
    assert {"ns=0;i=2342", "ns=0;i=11285"} <= set(functions)


def _expected(good: list[tuple[float, float]], start: int, end: int) -> dict[str, float | None]:
    inside = [value for at, value in good if start <= at < end]
    held = [(max(at, start), value) for at, value in good if at < end]
    held = held[-len(inside) - 1 :]  # with the value that was valid at the beginning
    ends = [at for at, _ in held[1:]] + [end]
    valid = [value for (at, value), until_ in zip(held, ends, strict=True) if until_ > at]
    area = sum(value * (until_ - at) for (at, value), until_ in zip(held, ends, strict=True))
    return {
        "TimeAverage2": area / (end - start),
        "Minimum2": min(valid),
        "Maximum2": max(valid),
        "Range2": max(valid) - min(valid),
        "Count": len(inside),
        "PercentGood": 100,
        "DurationGood": end - start,
        "DurationBad": 0,
        "Average": sum(inside) / len(inside) if inside else None,
        "Minimum": min(inside, default=None),
        "Maximum": max(inside, default=None),
    }


def _ms(time: str) -> float:
    return datetime.fromisoformat(time).timestamp() * 1000


def _iso(ms: float) -> str:
    return datetime.fromtimestamp(ms / 1000, UTC).isoformat(timespec="milliseconds")


def _alarm_is_acknowledged(plant: Plant) -> None:
    """An alarm is an event with its severity; its acknowledgement is the one of the user."""
    recipe, says = node("mixer/recipe"), plant.client.says
    assert plant.ask("write", recipe, "Int16", 35) == "Good"
    plant.ask("alarms")
    says("alarm", "mixer/recipe true false 700 Good")
    assert plant.ask("acknowledge", f"{recipe}@alarm") == "Good"
    says("alarm", "mixer/recipe true true 700 Good")
    assert plant.ask("write", recipe, "Int16", 7) == "Good"
    says("alarm", "mixer/recipe false true 700 Good")


REFUSED: dict[str, tuple[dict[str, Any], int, str]] = {
    "a wrong token": (
        {"token": "not-the-token-of-ana-at-all"},
        Code.BadUserAccessDenied,
        "the user 'ana' was refused",
    ),
    "a user of nobody": ({"user": "eve"}, Code.BadUserAccessDenied, "the user 'eve' was refused"),
    "no user": ({"user": None}, Code.BadIdentityTokenRejected, ""),
    "an unknown certificate": (
        {"certificate": certificate("stranger")},
        Code.BadSecurityChecksFailed,
        "certificate of stranger is not trusted",
    ),
    "an expired certificate": (
        {"certificate": "expired"},
        Code.BadCertificateTimeInvalid,
        "certificate of expired expired on",
    ),
    "a certificate of tomorrow": (
        {"certificate": "early"},
        Code.BadCertificateTimeInvalid,
        "certificate of early is not valid before",
    ),
    "the certificate of another application": (
        {"certificate": "other"},
        Code.BadCertificateUriInvalid,
        "certificate of other is not for the application 'urn:tests:client'",
    ),
}


async def test_only_known_applications_and_users_get_in(plant: Plant) -> None:
    for name, (given, code, sentence) in REFUSED.items():
        if isinstance(trusted := given.get("certificate"), str):
            file = plant.folder / "pki" / "trusted" / f"{trusted}.der"
            given = given | {"certificate": file.read_bytes()}
        client = await plant.unconnected(**given)
        with pytest.raises((ua.UaError, ConnectionError, TimeoutError)) as refused:
            async with client:
                pass
        assert getattr(refused.value, "code", code) == code, name
        plant.server.says(sentence)

    # A person trusts the unknown application.
    rejected = plant.folder / "pki" / "rejected"
    until(lambda: any(rejected.iterdir()), "its certificate is there")
    (new,) = rejected.iterdir()
    assert new.name.startswith("stranger-")
    new.rename(plant.folder / "pki" / "trusted" / new.name)
    while not await _connects(plant, certificate("stranger")):
        await asyncio.sleep(0.1)


async def _connects(plant: Plant, application: bytes) -> bool:
    client = await plant.unconnected(certificate=application)
    try:
        async with client:
            return True
    except (ua.UaError, ConnectionError):
        return False


async def test_a_user_without_the_role_reads_and_writes_nothing(plant: Plant) -> None:
    before = len(plant.gateway.written)
    async with plant.connected("ben", mode=ua.MessageSecurityMode.Sign) as client:
        recipe = client.get_node(node("mixer/recipe"))
        for attribute, access in (("AccessLevel", 3), ("UserAccessLevel", 1)):
            found = await recipe.read_attribute(getattr(ua.AttributeIds, attribute))
            assert found.Value is not None
            assert found.Value.Value == access
        value = ua.DataValue(ua.Variant(7, ua.VariantType.Int16))
        with pytest.raises(ua.uaerrors.BadUserAccessDenied):
            await recipe.write_value(value)
        status = ua.WriteValue(
            NodeId=ua.NodeId(ua.ObjectIds.Server_ServiceLevel),
            AttributeId=ua.AttributeIds.Value,
            Value=ua.DataValue(ua.Variant(0, ua.VariantType.Byte)),
        )
        (code,) = await client.uaclient.write(ua.WriteParameters(NodesToWrite=[status]))
        assert code.value == Code.BadNotWritable
    assert len(plant.gateway.written) == before


async def test_a_client_that_means_harm_reaches_nothing_of_the_others(plant: Plant) -> None:
    """asyncua alone takes each of these."""
    async with plant.connected() as client, plant.connected() as other:
        send = client.uaclient._send_request  # no public call makes such requests
        subscription = await other.create_subscription(50, Silent())
        number = ua.UInt32(subscription.subscription_id or 0)
        stolen = ua.DeleteSubscriptionsRequest()
        stolen.Parameters.SubscriptionIds = [number]
        watched = ua.CreateMonitoredItemsRequest()
        watched.Parameters.SubscriptionId = number
        many = ua.ReadRequest()
        many.Parameters.NodesToRead = [ua.ReadValueId()] * 3_000
        for request, code in (
            (ua.RegisterServerRequest(), Code.BadServiceUnsupported),
            (ua.AddNodesRequest(), Code.BadServiceUnsupported),
            (ua.CreateSessionRequest(), Code.BadTooManySessions),
            (many, Code.BadTooManyOperations),
            (watched, Code.BadSubscriptionIdInvalid),
        ):
            assert (await _result(send, request)).value == code, request
        found = struct_from_binary(ua.DeleteSubscriptionsResponse, await send(stolen))
        assert [code.value for code in found.Results] == [Code.BadSubscriptionIdInvalid]
        assert await subscription.subscribe_data_change(other.get_node(node("mixer/name")))

        # Its session is its own, and closed is closed.
        token = client.uaclient.session.authentication_token
        client.uaclient.session.restore_authentication_token(ua.NodeId(1010))
        assert (await _result(send, ua.ReadRequest())).value == Code.BadSessionIdInvalid
        client.uaclient.session.restore_authentication_token(token)
        assert (await _result(send, ua.CloseSessionRequest())).value == Code.Good
        assert (await _result(send, ua.ReadRequest())).value == Code.BadSessionNotActivated

    # Without security there is nothing but the list of endpoints.
    client = Client(plant.url, timeout=60)
    assert len(await client.connect_and_get_server_endpoints()) == 2
    with pytest.raises(ua.uaerrors.BadSecurityModeRejected):
        await client.connect()


async def _result(send: Callable[[Any], Awaitable[Buffer]], request: Any) -> ua.StatusCode:
    """Returns the result of a service."""
    try:
        await send(request)
    except ua.UaStatusCodeError as error:
        return ua.StatusCode(ua.UInt32(error.code))
    return ua.StatusCode()


async def test_a_folder_is_browsed_in_parts_and_wrong_values_are_not_sent(plant: Plant) -> None:
    before = len(plant.gateway.written)
    async with plant.connected() as client:
        every = ua.BrowseDescription(
            NodeId=ua.NodeId("/mixer/", 2),
            BrowseDirection=ua.BrowseDirection.Forward,
            ReferenceTypeId=ua.NodeId(ua.ObjectIds.HierarchicalReferences),
            IncludeSubtypes=True,
            NodeClassMask=ua.NodeClass.Variable,
            ResultMask=ua.UInt32(63),
        )
        part = ua.BrowseParameters(NodesToBrowse=[every])
        part.RequestedMaxReferencesPerNode = ua.UInt32(2)
        (found,) = await client.uaclient.browse(part)
        names = [one.BrowseName.Name for one in found.References]
        while found.ContinuationPoint:
            more = ua.BrowseNextParameters(False, [found.ContinuationPoint])
            (found,) = await client.uaclient.browse_next(more)
            names += [one.BrowseName.Name for one in found.References]
        assert names == ["speed", "recipe", "name", "steps", "level"]
        (stale,) = await client.uaclient.browse_next(more)
        assert stale.StatusCode.value == Code.BadContinuationPointInvalid

        level = client.get_node(node("mixer/level"))
        assert await level.read_data_type() == ua.NodeId(ua.ObjectIds.Double)
        for value, kind, code in (
            (float("nan"), ua.VariantType.Double, Code.BadOutOfRange),
            (float("-inf"), ua.VariantType.Double, Code.BadOutOfRange),
            (7, ua.VariantType.Int16, Code.BadTypeMismatch),
            ([1.0], ua.VariantType.Double, Code.BadTypeMismatch),
            ("7", ua.VariantType.String, Code.BadTypeMismatch),
        ):
            with pytest.raises(ua.UaStatusCodeError) as error:
                await level.write_value(ua.DataValue(ua.Variant(value, kind)))
            assert error.value.code == code
    assert len(plant.gateway.written) == before


@pytest.mark.parametrize(
    "sent",
    [
        b"HELF" + bytes(4),  # a size of nothing
        b"MSGF" + (2**32 - 1).to_bytes(4, "little") + bytes(200_000),  # of 4 GB
        b"OPNF" + (200).to_bytes(4, "little") + bytes(192),
        b"GET / HTTP/1.1\r\n\r\n" * 100,
    ],
)
def test_what_is_no_opc_ua_loses_its_connection_and_nothing_else(plant: Plant, sent: bytes) -> None:
    port = int(plant.url.rpartition(":")[2])
    with socket.create_connection(("127.0.0.1", port), 60) as client, suppress(ConnectionError):
        client.sendall(sent)
        while client.recv(1000):
            pass
    assert plant.ask("read", "i=2259")["status"] == "Good"


class Silent:
    """Takes what a subscription sends."""

    def datachange_notification(self, *_news: object) -> None: ...
