"""Modbus PDUs (application protocol V1.1b3, 6): requests by pymodbus, replies by `struct`."""

import sys
from array import array
from collections.abc import Callable, Sequence
from itertools import chain
from struct import Struct

from pymodbus.pdu.bit_message import (
    ReadCoilsRequest,
    ReadDiscreteInputsRequest,
    WriteMultipleCoilsRequest,
    WriteSingleCoilRequest,
)
from pymodbus.pdu.diag_message import ReturnQueryDataRequest
from pymodbus.pdu.pdu import ModbusPDU
from pymodbus.pdu.register_message import (
    MaskWriteRegisterRequest,
    ReadHoldingRegistersRequest,
    ReadInputRegistersRequest,
    WriteMultipleRegistersRequest,
    WriteSingleRegisterRequest,
)

from gateway.errors import NoReply, Refusal, Refused, Unclear
from gateway.protocols.modbus.frame import EXCEPTION, MASK_WRITE, WRITE_MANY, WRITE_SINGLE

_READS: dict[int, type[ModbusPDU]] = {
    1: ReadCoilsRequest,
    2: ReadDiscreteInputsRequest,
    3: ReadHoldingRegistersRequest,
    4: ReadInputRegistersRequest,
}

_EXCEPTIONS = {
    1: ("illegal function", Refusal.OTHER),
    2: ("illegal data address", Refusal.ADDRESS),
    3: ("illegal data value", Refusal.OTHER),
    4: ("device failure", Refusal.OTHER),
    5: ("acknowledged, but it takes longer", Refusal.BUSY),
    6: ("device busy", Refusal.BUSY),
    10: ("a gateway on the way has no path to the device", Refusal.BUSY),
}
_NO_RESPONSE_BEHIND = 11  # a Modbus TCP gateway got no reply from the device behind it

_BITS = tuple(tuple(byte >> bit & 1 for bit in range(8)) for byte in range(256))


def read_request(function: int, wire: int, count: int) -> bytes:
    return _encode(_READS[function](address=wire, count=count))


def write_bits_request(wire: int, bits: Sequence[int], *, single: bool) -> bytes:
    values = [bool(bit) for bit in bits]
    if single:
        return _encode(WriteSingleCoilRequest(address=wire, bits=values))
    return _encode(WriteMultipleCoilsRequest(address=wire, bits=values))


def write_words_request(wire: int, words: Sequence[int], *, single: bool) -> bytes:
    if single:
        return _encode(WriteSingleRegisterRequest(address=wire, registers=words))
    return _encode(WriteMultipleRegistersRequest(address=wire, registers=words))


def mask_request(wire: int, mask: int, bits: int) -> bytes:
    """Changes the bits of `mask` to those of `bits`."""
    keep = ~mask & 0xFFFF
    return _encode(MaskWriteRegisterRequest(address=wire, and_mask=keep, or_mask=bits))


def loopback_request(token: int) -> bytes:
    return _encode(ReturnQueryDataRequest(message=token.to_bytes(2, "big")))


def _encode(pdu: ModbusPDU) -> bytes:
    return bytes((pdu.function_code,)) + pdu.encode()


def bits_in(count: int) -> Callable[[bytes], Sequence[int]]:
    """Returns a decoder of `count` bits in a reply to function 01 or 02: lowest bit first."""

    def unpack(pdu: bytes) -> Sequence[int]:
        return list(chain.from_iterable(_BITS[byte] for byte in pdu[2:]))[:count]

    return unpack


def words_in(count: int) -> Callable[[bytes], Sequence[int]]:
    """Returns a decoder of `count` words in a reply to function 03 or 04: high byte first.

    The words are an array, two bytes each: a tuple takes 36 bytes for each word of a block.
    """
    last, found = b"", array("H")

    def unpack(pdu: bytes) -> Sequence[int]:
        nonlocal last, found
        if pdu != last:  # an equal reply gives the same units: they are not compared one by one
            words = array("H", pdu[2 : 2 + 2 * count])
            if len(words) != count:
                raise ValueError(f"{len(words)} words in a reply, not {count}")
            if sys.byteorder == "little":
                words.byteswap()
            last, found = pdu, words
        return found

    return unpack


def dwords_in(count: int, *, low_first: bool) -> Callable[[bytes], Sequence[int]]:
    """Returns a decoder of `count` pairs of words in a reply to function 03."""
    words = Struct(f">{2 * count}H")
    low, high = (0, 1) if low_first else (1, 0)

    def unpack(pdu: bytes) -> Sequence[int]:
        heard = words.unpack_from(pdu, 2)
        return [a | b << 16 for a, b in zip(heard[low::2], heard[high::2], strict=True)]

    return unpack


def words_of(dwords: Sequence[int], *, low_first: bool) -> list[int]:
    """Returns the words of these 32-bit units."""
    pairs = ((dword & 0xFFFF, dword >> 16) for dword in dwords)
    return [word for low, high in pairs for word in ((low, high) if low_first else (high, low))]


def objects_in(reply: bytes) -> dict[int, str] | None:
    """Returns the objects in a reply to function 43; None for another frame."""
    objects, at = dict[int, str](), 7
    while at + 2 <= len(reply):
        number, end = reply[at], at + 2 + reply[at + 1]
        objects[number] = reply[at + 2 : end].decode("latin-1")
        at = end
    return objects if at == len(reply) and len(objects) == reply[6] else None


_ACCEPTED = 5
_WRITES = (*WRITE_SINGLE, *WRITE_MANY, MASK_WRITE)
_NOT_DONE = (1, 2, 3, 6, 10)  # exceptions without any effect
# Of these, the exceptions that name no address and no value: of several none was looked at.
_UNEXECUTED = (1, 6, 10)


def is_absence(pdu: bytes) -> bool:
    """Returns True for the exceptions 0A and 0B: a gateway did not reach the device behind it."""
    return len(pdu) == 2 and bool(pdu[0] & EXCEPTION) and pdu[1] in (10, _NO_RESPONSE_BEHIND)


def raise_refusal(pdu: bytes, function: int, *, numbered: bool = False) -> None:
    """Raises the error of an exception reply to `function`; ignores other PDUs.

    `numbered`: its number names the request, so the function that it names does not count.

    `Refused` with the exception code in hex; `NoReply` for 0B, from a gateway whose device did
    not reply: a write may have been done. `Unclear` for 05 to a write, which was accepted and
    may be done later, and for every other exception to a write after which part may be done.
    """
    if len(pdu) != 2 or not pdu[0] & EXCEPTION:
        return
    if pdu[0] != function | EXCEPTION and not numbered:
        return
    code = pdu[1]
    if code == _NO_RESPONSE_BEHIND:
        raise NoReply("a gateway on the way got no answer from the device (exception 0B)")
    if code == _ACCEPTED and function in _WRITES:
        raise Unclear("accepted, but it takes longer (exception 05): it may be done yet")
    words, refusal = _EXCEPTIONS.get(code, ("unknown exception", Refusal.OTHER))
    said = f"exception {code:02X} to function {function:02d}: {words}"
    if function in _WRITES and code not in _NOT_DONE:
        raise Unclear(f"{said}; part of it may be done")
    unexecuted = code in _UNEXECUTED
    raise Refused(said, code=f"{code:02X}", refusal=refusal, unexecuted=unexecuted)
