"""Finds requests and replies of the Vigor computer link in the bytes of a line."""

from gateway.errors import Garbled
from gateway.protocols.listening import Asked, DelimitedTrafficReader, Told
from gateway.protocols.vigor.codec import (
    ACK,
    GOOD,
    LONGEST_REQUEST,
    READ,
    SHORT_REPLY,
    STX,
    Reply,
    first_reply,
    first_request,
)


def vigor_traffic_reader() -> DelimitedTrafficReader:
    return DelimitedTrafficReader(STX + ACK, LONGEST_REQUEST, _take)


def _take(data: bytes) -> tuple[Asked | Told, int] | int | None:
    try:
        if data[:1] == ACK:
            reply, size = first_reply(data)
            return 0 if reply is None else (_told(reply), size)
        request, size = first_request(data)
    except Garbled:
        return None
    return 0 if request is None else (_asked(request), size)


def _told(reply: Reply) -> Told:
    if reply.status != GOOD:
        return Told(reply.station, reply.command, is_error=True)
    return Told(reply.station, (reply.command, len(reply.data)), reply.data)


def _asked(whole: bytes) -> Asked:
    station, command = int(whole[1:3], 16), whole[3:5].decode("latin-1")
    read = None
    if command == READ and len(whole) == 14:
        read = int(whole[5:9], 16), int(whole[9:11], 16)
    count = read[1] if read is not None else 0
    size = SHORT_REPLY + 2 * count
    return Asked(station, whole, size, (command, count), command, read)
