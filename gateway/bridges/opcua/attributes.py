"""The attributes and properties of the node of a tag, from its description."""

from asyncua import ua

from gateway.bridges.documents import Known
from gateway.bridges.opcua.values import type_of

Ids, Attribute, Type, Level = ua.ObjectIds, ua.AttributeIds, ua.VariantType, ua.AccessLevel
Fields = dict[int, ua.Variant]  # by attribute
PROPERTIES = {"unit": "EngineeringUnits", "range": "EURange"}


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
