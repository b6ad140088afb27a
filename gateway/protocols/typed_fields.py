"""Typed fields: addresses with a type and access that the driver itself knows, as in frames.

A driver may have this capability. A read of a typed field returns its value, not words, or
the `Garbled` that hides it; a write sends the bytes of the value.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from gateway.protocols.driver import Address
from gateway.values import ValueType
from gateway.values.numerals import Scalar


class Shape(Protocol):
    """The encoding of a value in its frame."""

    def put(self, value: Scalar) -> bytes:
        """Returns its bytes. Raises `BadValue`."""

    def take(self, raw: bytes) -> Scalar:
        """Returns the value of these bytes. Raises `Garbled`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TypedField:
    """The type, the encoding and the access of one address."""

    type: ValueType
    shape: Shape
    polled: bool  # a request reads it
    unsolicited: bool  # it arrives in unsolicited frames
    writable: bool
    event_hint: str = ""  # for a message: where the file declares unsolicited fields
    write_hint: str = ""  # for a message: where the file makes the field writable


@runtime_checkable
class TypedFields(Protocol):
    """A driver whose addresses are typed fields."""

    def typed_field(self, address: Address) -> TypedField: ...
