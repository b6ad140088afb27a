"""OPC UA: a server with the values of the gateway, acknowledged writes, and history.

* Address space: Objects / plant / a folder for each device (and for each `/` of a tag) / a variable
  for each tag: `ns=2;s=mixer/speed`, with data type, description, unit, and the limits of a write.
  An array has one dimension; a write has all of its elements.
* Values: time and quality of the gateway as source time stamp and status code (`STATUS` in
  values.py).
* Writes, with `--writes`: Good only after the device has acknowledged. BadTimeout: unknown, it may
  or may not have been done; read the value before you write again. Every other code: not done
  (`NOT_DONE` below). The bridge never repeats a write.
* HistoryRead of raw values, for tags with `history: true`.

Everyone who can connect can read, and write with `--writes`. So listen on 127.0.0.1 beside the OPC
UA client, or put a tunnel or a firewall before the port.
"""

import asyncio
import logging
from typing import ClassVar

from asyncua import Server, ua
from asyncua.common.utils import Buffer
from asyncua.crypto.permission_rules import User, UserRole
from asyncua.server import binary_server_asyncio
from asyncua.server.address_space import AttributeService
from asyncua.server.uaprocessor import UaProcessor
from asyncua.ua.ua_binary import nodeid_from_binary

from gateway.bridges.documents import Known
from gateway.bridges.opcua.values import History, data_value, type_of
from gateway.bridges.program import Gateways, opened, say
from gateway.bridges.remote_plant import RemotePlant

Code = ua.StatusCodes
NOT_DONE = {  # by the outcome of a write
    "not-writable": Code.BadNotWritable,
    "bad-value": Code.BadOutOfRange,
    "unknown-tag": Code.BadNodeIdUnknown,
    "not-allowed": Code.BadUserAccessDenied,
    "wrong-device": Code.BadConfigurationError,
    "busy": Code.BadTooManyOperations,
    "line-down": Code.BadNotConnected,
    "no-reply": Code.BadDeviceFailure,
    "refused": Code.BadInvalidState,
    "no-gateway": Code.BadNoCommunication,
}
MOST_WRITES = 100  # that wait; the next one is refused


class Processor(UaProcessor):
    """Lets a client read on while a write of its own waits for the device."""

    _WRITE = ua.NodeId(ua.ObjectIds.WriteRequest_Encoding_DefaultBinary)
    _open: ClassVar[set[asyncio.Task[bool]]] = set()

    async def process_message(self, seqhdr: object, body: Buffer) -> bool:
        if nodeid_from_binary(body.copy()) != self._WRITE:
            return await super().process_message(seqhdr, body)
        task = asyncio.create_task(super().process_message(seqhdr, body))
        self._open.add(task)
        task.add_done_callback(self._open.discard)
        return True


class Bridge(AttributeService):
    """The address space; performs the writes of clients."""

    def __init__(self, server: Server, writes: bool) -> None:
        super().__init__(server.iserver.aspace)
        server.iserver.attribute_service = self
        self.plant: RemotePlant
        self._server, self._writes, self._open = server, writes, 0
        self._space = 0
        self._types: dict[str, ua.VariantType] = {}
        self._folders: set[str] = set()
        self._new: dict[str, None] = {}  # keys with a new description
        self._pending: dict[str, None] = {}  # keys with a new value
        self._news = asyncio.Event()

    def described(self, key: str, _meta: Known) -> None:
        self._new[key] = None
        self._news.set()

    def changed(self, key: str, _known: Known) -> None:
        self._pending[key] = None
        self._news.set()

    async def serve(self, prefix: str) -> None:
        """Updates nodes and values for ever."""
        self._space = await self._server.register_namespace(f"urn:zenoh-plc-gateway:{prefix}")
        await self._server.nodes.objects.add_folder(self._node("/"), f"{self._space}:{prefix}")
        while True:
            await self._news.wait()
            self._news.clear()
            while self._new or self._pending:
                if self._new:
                    key = next(iter(self._new))
                    del self._new[key]
                    await self._describe(key, self.plant.tags[key])
                else:
                    key = next(iter(self._pending))
                    del self._pending[key]
                value = data_value(self.plant.values[key], self._types[key])
                await self._server.write_attribute_value(self._node(key), value)

    def _node(self, key: str) -> ua.NodeId:
        return ua.NodeId(key, self._space)  # the key of a tag, or `/mixer/` of a folder

    async def _describe(self, key: str, meta: Known) -> None:
        if key in self._types:
            await self._server.delete_nodes([self._server.get_node(self._node(key))], True)
        *levels, name = key.split("/")
        folder = "/"
        for level in levels:
            parent, folder = folder, f"{folder}{level}/"
            if folder not in self._folders:
                self._folders.add(folder)
                parent_node = self._server.get_node(self._node(parent))
                await parent_node.add_folder(self._node(folder), f"{self._space}:{level}")
        kind = self._types[key] = type_of(meta)
        access = ua.AccessLevel.CurrentRead.mask
        if self._writes and meta["write"]:
            access |= ua.AccessLevel.CurrentWrite.mask
        if meta["history"]:
            access |= ua.AccessLevel.HistoryRead.mask
        node = await self._server.get_node(self._node(folder)).add_variable(
            self._node(key),
            f"{self._space}:{name}",
            None,
            ua.VariantType.Null,
            ua.NodeId(kind.value),
        )
        for attribute, value in (
            (ua.AttributeIds.AccessLevel, ua.Variant(access, ua.VariantType.Byte)),
            (ua.AttributeIds.UserAccessLevel, ua.Variant(access, ua.VariantType.Byte)),
            (ua.AttributeIds.Historizing, ua.Variant(bool(meta["history"]))),
            *_dimensions(meta.get("length")),
            (ua.AttributeIds.Description, ua.Variant(ua.LocalizedText(meta["description"]))),
        ):
            await node.write_attribute(attribute, ua.DataValue(value))
        if unit := meta["unit"]:
            shown = ua.LocalizedText(unit)
            about = ua.EUInformation("urn:zenoh-plc-gateway", -1, shown, shown)
            await node.add_property(self._node(f"{key}@unit"), "0:EngineeringUnits", about)
        limits = meta["write"] or meta.get("clamp") or {}
        low, high = limits.get("min"), limits.get("max")
        if low is not None and high is not None:
            about = ua.Range(Low=low, High=high)
            await node.add_property(self._node(f"{key}@range"), "0:EURange", about)

    async def write(self, params: ua.WriteParameters, user: User) -> list[ua.StatusCode]:
        if user.role == UserRole.Admin:  # this program itself
            return await super().write(params, user)
        items = params.NodesToWrite
        if self._open + len(items) > MOST_WRITES:
            return [ua.StatusCode(Code.BadTooManyOperations)] * len(items)
        self._open += len(items)
        try:
            codes = await asyncio.gather(*map(self._write, items))
        finally:
            self._open -= len(items)
        return [ua.StatusCode(code) for code in codes]

    async def _write(self, item: ua.WriteValue) -> int:
        key, variant = item.NodeId.Identifier, item.Value.Value
        if item.NodeId.NamespaceIndex != self._space or key not in self._types:
            return Code.BadNotWritable
        if item.AttributeId != ua.AttributeIds.Value or item.IndexRange:
            return Code.BadWriteNotSupported
        if not self._writes or not self.plant.tags[key]["write"]:
            return Code.BadNotWritable
        if item.Value.StatusCode is not None and item.Value.StatusCode.value != Code.Good:
            return Code.BadWriteNotSupported
        if variant is None or variant.VariantType != self._types[key]:
            return Code.BadTypeMismatch
        if variant.is_array != bool(self.plant.tags[key].get("length")):
            return Code.BadTypeMismatch
        outcome = await self.plant.write(key, variant.Value)
        say(f"{key} = {variant.Value}: {outcome['outcome']} {outcome.get('reason', '')}")
        if outcome["outcome"] == "written":
            return Code.Good
        return NOT_DONE.get(outcome["outcome"], Code.BadTimeout)


def _dimensions(length: int | None) -> list[tuple[ua.AttributeIds, ua.Variant]]:
    """Returns the attributes of an array."""
    if length is None:
        return []
    sizes = ua.Variant([length], ua.VariantType.UInt32, is_array=True)
    rank = ua.Variant(ua.ValueRank.OneDimension.value, ua.VariantType.Int32)
    return [(ua.AttributeIds.ValueRank, rank), (ua.AttributeIds.ArrayDimensions, sizes)]


async def bridge(gateways: Gateways, listen: str, writes: bool) -> None:
    """Serves until it is cancelled."""
    logging.basicConfig(level=logging.ERROR)
    binary_server_asyncio.UaProcessor = Processor
    server = Server()
    served = Bridge(server, writes)
    await server.init()
    server.set_endpoint(listen)
    server.set_server_name("zenoh-plc-gateway")
    server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    # Only these: asyncua takes a user named `admin` for its own, and lets it write all nodes.
    server.set_identity_tokens([ua.AnonymousIdentityToken])
    with await opened(gateways) as session:
        served.plant = RemotePlant(session, gateways.prefix, served.described, served.changed)
        server.iserver.history_manager = History(server.iserver, served.plant)
        async with server, asyncio.TaskGroup() as group:
            group.create_task(served.serve(gateways.prefix))
            group.create_task(served.plant.follow())
            say(f"listening on {listen}")
