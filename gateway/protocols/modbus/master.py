"""The master's side of Modbus: requests to one device and their replies, without framing."""

from collections.abc import (
    Callable,
    Collection,
    Coroutine,
    Hashable,
    Iterator,
    Mapping,
    Sequence,
)
from dataclasses import dataclass, field
from itertools import count, repeat
from typing import Any, NamedTuple, TypeVar

from gateway.errors import BadValue, Refused, RefusedOther, Took
from gateway.protocols.driver import EVERY_REQUEST, PROOF, Span, Talk, Unit
from gateway.protocols.harmless import HarmlessReads, beside, resync_by_reads
from gateway.protocols.modbus import pdu
from gateway.protocols.modbus.addressing import Place
from gateway.protocols.modbus.frame import EXCEPTION, Frame, answer_length
from gateway.protocols.modbus.identity import NAMES, identify
from gateway.protocols.modbus.settings import Settings
from gateway.protocols.modbus.traffic import Read
from gateway.protocols.resync_kind import ResyncKind

T = TypeVar("T")
_REMEMBERED = 1024  # spans whose request is kept ready
_FEWEST_SIZES, _MOST_SIZES = 4, 16  # of the reads that a resync may send


class ReadRequest(NamedTuple):
    """A read, ready to be sent, and the reply that it expects."""

    request: bytes
    head: bytes  # function and byte count of the reply
    length: int  # of the reply's PDU
    chars: int  # of the whole reply
    units: Callable[[bytes], Sequence[int]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Master(Settings):
    """The requests to one device."""

    _numbers: Iterator[int] = field(init=False, repr=False, compare=False)
    _prepared: dict[Span, ReadRequest] = field(init=False, repr=False, compare=False)
    _kind: ResyncKind = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        object.__setattr__(self, "_numbers", count(1) if self.numbered else repeat(0))
        object.__setattr__(self, "_prepared", {})
        object.__setattr__(self, "_kind", ResyncKind())

    async def read(self, talk: Talk[Frame], span: Span) -> Sequence[int]:
        request, head, length, chars, units = self._prepared.get(span) or self._prepare(span)
        station, number = self.station, next(self._numbers) & 0xFFFF
        function = head[0]

        def answers(frame: Frame) -> Sequence[int] | None:
            heard = frame.pdu
            if frame.station != station or frame.transaction != number:
                return None
            if len(heard) == length and heard[:2] == head:
                return () if heard == request and not self.numbered else units(heard)
            pdu.raise_refusal(heard, function, numbered=self.numbered)
            return None

        said = await talk.ask(Frame(station, request, number), chars, answers)
        if said:
            return said
        # 17 to 24 coils from wire address 03xxh: the reply may be equal to the request, so the
        # received bytes may be its echo. Two shorter replies cannot be equal to their requests.
        area, start, size = span
        first = await self.read(talk, Span(area, start, 16))
        return [*first, *await self.read(talk, Span(area, start + 16, size - 16))]

    def _prepare(self, span: Span) -> ReadRequest:
        place = self.place_of(span)
        if place is None or self.cost(span) is None:
            raise BadValue(f"{span} cannot be read with one request")
        registers = span.size * place.registers
        request = pdu.read_request(place.function, place.at(span.start), registers)
        length = answer_length(request)
        units = self._units_in(place, span)
        head = bytes((place.function, length - 2))
        prepared = ReadRequest(request, head, length, self.chars(length), units)
        if len(self._prepared) >= _REMEMBERED:
            self._prepared.clear()
        self._prepared[span] = prepared
        return prepared

    def _units_in(self, place: Place, span: Span) -> Callable[[bytes], Sequence[int]]:
        """Returns the decoder of a reply that holds the span and nothing else."""
        if place.of_bits:
            return pdu.bits_in(span.size)
        if place.area.unit is Unit.DWORD:
            return pdu.dwords_in(span.size, low_first=self.counter_word_order == "low_first")
        return pdu.words_in(span.size)

    def learn(self, read: Read, span: Span) -> Callable[[bytes], Sequence[int]] | None:
        """Returns the decoder of the span in the reply to a read; None if it is not all in it."""
        place = self.place_of(span)
        if place is None or self.broadcast or place.function != read.function:
            return None
        begin, size = place.at(span.start) - read.wire, span.size * place.registers
        if begin < 0 or begin + size > read.size:
            return None
        if place.of_bits:
            of_all = pdu.bits_in(read.size)
            return lambda reply: of_all(reply)[begin : begin + size]
        units = self._units_in(place, span)
        return lambda reply: units(reply[:2] + reply[2 + 2 * begin : 2 + 2 * (begin + size)])

    async def write(self, talk: Talk[Frame], span: Span, units: Sequence[int]) -> bool:
        return await self._send(talk, self._write_request(span, units))

    def changes_bits(self, span: Span) -> bool:
        """True for a register of a device whose manual does not say that it lacks function 22."""
        place = self.place_of(span)
        own = place is not None and place.function == 3 and place.area.writable
        return own and self.dialect.standard and not self.broadcast

    async def change_bits(self, talk: Talk[Frame], span: Span, mask: int, bits: int) -> bool:
        wire = self.dialect.places[span.area].at(span.start)
        return await self._send(talk, pdu.mask_request(wire, mask, bits))

    async def _send(self, talk: Talk[Frame], request: bytes) -> bool:
        """Sends a write. Returns False for a broadcast, which has no reply."""
        number = next(self._numbers) & 0xFFFF
        frame = Frame(self.station, request, number)
        if self.broadcast:
            await talk.tell(frame)
            return False
        length = answer_length(request)  # 15 and 16 repeat address and count, others all
        good = {request[:length]}
        if self.dialect.forgets_address and request[0] == 6:
            good.add(request[:1] + bytes(2) + request[3:])

        echo = None if self.numbered or not talk.may_echo else request

        def answers(heard: Frame) -> bool | None:
            nonlocal echo
            if heard.station != frame.station or heard.transaction != number:
                return None
            if heard.pdu == echo:
                echo = None  # perhaps the echo: the device must send the same again
                return None
            if heard.pdu in good:
                return True
            if request[0] == 6 and heard.pdu[:3] == request[:3] and len(heard.pdu) == 5:
                raise Took([int.from_bytes(heard.pdu[3:])])
            pdu.raise_refusal(heard.pdu, request[0], numbered=self.numbered)
            return None

        return await talk.ask(frame, self.chars(length), answers)

    def _write_request(self, span: Span, units: Sequence[int]) -> bytes:
        place = self.place_of(span)
        if place is None or self.write_cost(span) is None or len(units) != span.size:
            raise BadValue(f"{len(units)} units for {span} cannot be written with one request")
        largest = place.area.unit.largest
        if not all(0 <= unit <= largest for unit in units):
            raise BadValue(f"units of {span.area} are 0 to {largest}")
        wire, single = place.at(span.start), self.is_single(place, span)
        if place.of_bits:
            return pdu.write_bits_request(wire, units, single=single)
        if place.area.unit is Unit.DWORD:
            units = pdu.words_of(units, low_first=self.counter_word_order == "low_first")
        return pdu.write_words_request(wire, units, single=single)

    async def resync(
        self,
        talk: Talk[Frame],
        outstanding: Span | None,
        probe_token: int,
        spans: Sequence[Span] = (),
    ) -> int:
        """Reads another byte count than the `outstanding` read, or sends a token by function 08,
        as the device answers.

        Function 08 is not used while its reply may be an echo: a dead device would seem online.
        An exception names no address: it may be the late reply to the `outstanding` read. So one
        more read with another byte count follows it, unless requests carry a number.

        Reads stay inside the `spans`. If they hold no read of another byte count, every second
        resync reads one of them, in turn, and the others read beyond the spans.
        """
        pick = self._harmless_pick(outstanding, spans)
        loopback = self._may_loop(probe_token) and (self.numbered or not talk.may_echo)
        with self._kind.sent(probe_token, loopback=loopback):
            if not loopback and not self.numbered:
                return await resync_by_reads(
                    lambda span: self.read(talk, span),
                    *(probe_token, outstanding, pick, self.reply_shape),
                )
            try:
                if loopback:
                    await self._loopback(talk, probe_token & 0xFFFF)
                else:
                    await self.read(talk, pick(probe_token))
            except Refused:
                if not self.numbered:
                    raise
            return EVERY_REQUEST

    def _may_loop(self, token: int) -> bool:
        """Returns True if the resync with this token is by function 08, where nothing echoes."""
        return self.diagnostics and self._kind.is_loopback(token)

    def _harmless_pick(
        self, outstanding: Span | None, spans: Sequence[Span]
    ) -> Callable[[int], Span]:
        """Returns the read of each probe token."""
        inside = HarmlessReads(spans, outstanding, self.reply_shape, self.numbered)
        # The device may be silent about the outstanding address: the others are asked first. One
        # that is not in the spans is known as bad, or was written: nothing near it is read.
        alike = beside(spans, outstanding)
        if inside and (inside.are_beside or not alike):
            return lambda token: (inside.proof() if token == PROOF else None) or inside.pick(token)
        beyond = self._harmless(spans[0] if spans and outstanding not in spans else outstanding)
        if outstanding is not None and outstanding in spans:
            alike.append(outstanding)

        def pick(token: int) -> Span:
            step, second = divmod(token, 2)
            if alike and step % 2:
                return alike[(step // 2 + second) % len(alike)]
            return inside.pick(token) if inside else beyond[token % len(beyond)]

        return pick

    def _harmless(self, outstanding: Span | None) -> Sequence[Span]:
        """Short reads near the `outstanding` one, of different byte counts, none equal to its."""
        places = self.dialect.places
        near = outstanding
        if near is None or self.place_of(near) is None:
            first = (places.get("D") or next(iter(places.values()))).area
            near = Span(first.name, first.first, 0)
        place = places[near.area]
        area, step = place.area, 8 if place.of_bits else 1
        steps = (near.size + step - 1) // step
        room = min(self.most(place, reading=True) // place.registers, area.last - area.first + 1)
        # Small ones first: they lie within the outstanding read, at addresses that the device has.
        most = max(_FEWEST_SIZES, min(steps - 1, _MOST_SIZES))
        sizes = [n * step for n in range(1, most + 2) if n != steps and n * step <= room][:most]
        if not sizes:  # limited to one unit: the reply to another function differs as well
            other = next(p for p in places.values() if p.function != place.function).area
            return [Span(other.name, other.first, 1)]
        return [Span(area.name, min(near.start, area.last + 1 - n), n) for n in sizes]

    # Listening to another master, and the shapes of replies

    @property
    def framing(self) -> Hashable:
        return self.protocol

    @property
    def unnumbered(self) -> bool:
        return not self.numbered

    def is_reply(self, frame: Frame) -> bool:
        return isinstance(frame, Frame) and frame.station == self.station

    def refusal_of_another(self, frame: Frame) -> RefusedOther | None:
        """An exception whose function is not that of the request."""
        heard = frame.pdu
        if frame.station != self.station or len(heard) != 2 or heard[0] < EXCEPTION:
            return None
        code, function = f"{heard[1]:02X}", heard[0] - EXCEPTION
        why = f"exception {code} to function {function:02d}, which was not sent"
        return RefusedOther(why, heard, code=code)

    def reply_shape(self, span: Span) -> Hashable:
        """Function and length: a reply to a read names no address."""
        cost, place = self.cost(span), self.place_of(span)
        return None if cost is None or place is None else (place.function, cost.reply)

    def write_shapes(self, span: Span, units: Sequence[int]) -> Sequence[Hashable]:
        """The whole reply: it repeats the address, and the value or the count."""
        try:
            request = self._write_request(span, units)
        except BadValue:
            return (None,)
        if self.dialect.forgets_address and request[0] == 6:
            return (request[:1] + bytes(2) + request[3:],)
        return (request[:5],)

    def resync_shape(
        self, outstanding: Span | None, probe_token: int, spans: Sequence[Span] = ()
    ) -> Hashable:
        """None for function 08 with its token."""
        if self._may_loop(probe_token):
            return None
        inside = HarmlessReads(spans, outstanding, self.reply_shape)
        if probe_token == PROOF and inside.proof() is None:
            return None
        return self.reply_shape(self._harmless_pick(outstanding, spans)(probe_token))

    async def _loopback(self, talk: Talk[Frame], token: int) -> None:
        request = pdu.loopback_request(token)
        await self.ask(talk, request, 5, lambda heard: heard == request or None)

    async def ask(
        self, talk: Talk[Frame], request: bytes, longest: int, accept: Callable[[bytes], T | None]
    ) -> T:
        """Sends a request. `accept` returns the contents of its reply of at most `longest` bytes,
        or None for another frame."""
        number = next(self._numbers) & 0xFFFF

        def answers(heard: Frame) -> T | None:
            if heard.station != self.station or heard.transaction != number:
                return None
            if (found := accept(heard.pdu)) is not None:
                return found
            pdu.raise_refusal(heard.pdu, request[0], numbered=self.numbered)
            return None

        return await talk.ask(Frame(self.station, request, number), self.chars(longest), answers)

    @property
    def identity_names(self) -> Collection[str]:
        return NAMES if self.dialect.standard and not self.broadcast else ()

    def identify(
        self, talk: Talk[Frame], names: Collection[str]
    ) -> Coroutine[Any, Any, Mapping[str, Sequence[str]]]:
        return identify(self.ask, talk, names)
