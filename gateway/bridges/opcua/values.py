"""Values of the gateways as OPC UA has them, and the attributes of a tag from its description."""

import struct
from datetime import UTC, datetime

from asyncua import ua
from asyncua.ua.ua_binary import variant_to_binary

from gateway.bridges.documents import Known
from gateway.contract.documents.catalogue import REASONS

Code, Type = ua.StatusCodes, ua.VariantType
Attribute, Level = ua.AttributeIds, ua.AccessLevel
Fields = dict[int, ua.Variant]  # by attribute
PROPERTIES = {"unit": "EngineeringUnits", "range": "EURange"}

STATUS = {  # by the reason of a bad value
    reason.value: getattr(Code, code) for reason, (code, _) in REASONS.items()
} | {"no-gateway": Code.BadNoCommunication}
ORIGIN = {
    "simulated": Code.GoodEdited,
    "replayed": Code.GoodEdited,
    "held": Code.GoodLocalOverride,
}
LIMITED = {"low": 0x0500, "high": 0x0600}  # limit bits of a status code, of a data value
TYPES = {  # by the type of a tag; the others are texts
    "bool": Type.Boolean,
    "int8": Type.SByte,
    "uint8": Type.Byte,
    "int16": Type.Int16,
    "uint16": Type.UInt16,
    "int32": Type.Int32,
    "uint32": Type.UInt32,
    "int64": Type.Int64,
    "uint64": Type.UInt64,
    "float32": Type.Float,
    "float64": Type.Double,
    "bcd16": Type.UInt16,
    "bcd32": Type.UInt32,
}


def type_of(meta: Known) -> ua.VariantType:
    return TYPES.get(meta["type"].partition("[")[0], Type.String)


def data_value(known: Known, kind: ua.VariantType) -> ua.DataValue:
    time = datetime.fromisoformat(known["time"]).astimezone(UTC)
    now = datetime.now(UTC)
    quality, reason = known["quality"], known.get("reason", "")
    variant = None
    if quality not in ("good", "uncertain"):
        code = STATUS.get(reason, Code.Bad)
    elif (variant := variant_of(known["value"], kind)) is None:
        code = Code.BadTypeMismatch
    else:
        code = Code.Good if quality == "good" else STATUS.get(reason, Code.Uncertain)
        if quality == "good":  # not simply Good, unless it is the reading of a device
            code = ORIGIN.get(known.get("origin", ""), code)
        code |= LIMITED.get(known.get("limited", ""), 0)
    return ua.DataValue(variant or ua.Variant(), ua.StatusCode(code), time, now)


def variant_of(value: object, kind: ua.VariantType) -> ua.Variant | None:
    """Returns None if the type cannot hold the value."""
    if kind in (Type.Float, Type.Double) and type(value) is int:
        value = float(value)
    if isinstance(value, list):
        if any(variant_of(one, kind) is None for one in value):
            return None
        variant = ua.Variant(value, kind, is_array=True)
    else:
        expected = {Type.Boolean: bool, Type.String: str, Type.Float: float, Type.Double: float}
        if type(value) is not expected.get(kind, int):
            return None
        variant = ua.Variant(value, kind)
    try:
        variant_to_binary(variant)
    except (ua.UaError, struct.error, OverflowError):
        return None
    return variant


def properties(meta: Known) -> dict[str, ua.Variant]:
    """Returns the properties of a tag: `unit`, and `range` where both ends are known."""
    found = {}
    if unit := meta["unit"]:
        shown = ua.LocalizedText(unit)
        about = ua.EUInformation("urn:zenoh-plc-gateway", -1, shown, shown)
        found["unit"] = ua.Variant(about, Type.ExtensionObject)
    for limits in (meta["write"], meta.get("clamp"), meta.get("range")):
        low, high = (limits or {}).get("min"), (limits or {}).get("max")
        if low is not None and high is not None:
            found["range"] = ua.Variant(ua.Range(Low=low, High=high), Type.ExtensionObject)
            break
    return found


def of_tag(meta: Known) -> Fields:
    """Returns the attributes of a tag, without its value."""
    access = Level.CurrentRead.mask
    if meta["write"]:
        access |= Level.CurrentWrite.mask
    if meta["history"]:
        access |= Level.HistoryRead.mask
    text = ua.LocalizedText(meta["description"])
    data_type = ua.NodeId(type_of(meta).value)
    found = variable(data_type, access, meta.get("length"), bool(meta["history"]))
    return found | {Attribute.Description: ua.Variant(text, Type.LocalizedText)}


def variable(
    data_type: ua.NodeId, access: int, length: int | None = None, historizing: bool = False
) -> Fields:
    """Returns the attributes that each variable has."""
    rank = ua.ValueRank.Scalar if length is None else ua.ValueRank.OneDimension
    found = {
        Attribute.DataType: ua.Variant(data_type, Type.NodeId),
        Attribute.ValueRank: int32(rank),
        Attribute.AccessLevel: ua.Variant(access, Type.Byte),
        Attribute.UserAccessLevel: ua.Variant(access, Type.Byte),
        Attribute.MinimumSamplingInterval: ua.Variant(0.0, Type.Double),
        Attribute.Historizing: ua.Variant(historizing, Type.Boolean),
    }
    if length is not None:
        found[Attribute.ArrayDimensions] = ua.Variant([length], Type.UInt32, is_array=True)
    return found


def int32(value: int) -> ua.Variant:
    return ua.Variant(int(value), Type.Int32)
