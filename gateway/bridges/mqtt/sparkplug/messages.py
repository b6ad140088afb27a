"""The messages of Sparkplug B, with the names and numbers of its specification (chapter 6.4).

Those that a gateway has no use for are left out: data sets, templates, files. Where another program
sends them, they are fields that are not known.
"""

from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

_VALUES = (
    "int_value:uint32 long_value:uint64 float_value:float double_value:double boolean_value:bool"
)
_VALUES += " string_value:string"
_FIELDS = {  # by message: name:type of the fields from a number on; `*`: repeated
    "PropertyValue": {1: f"type:uint32 is_null:bool {_VALUES}"},
    "PropertySet": {1: "keys:*string values:*PropertyValue"},
    "Metric": {
        1: "name:string alias:uint64 timestamp:uint64 datatype:uint32 is_historical:bool",
        6: "is_transient:bool is_null:bool",
        9: f"properties:PropertySet {_VALUES} bytes_value:bytes",
    },
    "Payload": {1: "timestamp:uint64 metrics:*Metric seq:uint64"},
}


def _made() -> Any:
    """Returns the class of a payload."""
    field = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="sparkplug_b.proto", package="spb")
    for message, parts in _FIELDS.items():
        described = file.message_type.add(name=message)
        for first, text in parts.items():
            for number, (name, _, kind) in enumerate(
                (word.partition(":") for word in text.split()), first
            ):
                own = described.field.add(name=name, number=number)
                own.label = field.LABEL_REPEATED if kind[0] == "*" else field.LABEL_OPTIONAL
                kind = kind.removeprefix("*")
                if kind in _FIELDS:
                    own.type, own.type_name = field.TYPE_MESSAGE, f".spb.{kind}"
                else:
                    own.type = getattr(field, f"TYPE_{kind.upper()}")
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("spb.Payload"))


Payload = _made()
