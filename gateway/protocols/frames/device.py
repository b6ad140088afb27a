"""A device without a protocol: the frames that it sends and accepts.

The file names its frames. `listen`: unsolicited frames. `ask`: a request and its reply.
`write`: a frame with a value. The address of a tag is the name of a field of these frames; a
value to write is named as its frame.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeVar

from gateway.errors import BadValue, ConfigError, Garbled
from gateway.protocols.driver import Cost, Talk, Timing
from gateway.protocols.frames.bytetext import NAME, octets
from gateway.protocols.frames.codec import FrameCodec, FrameReader
from gateway.protocols.frames.fields import Field
from gateway.protocols.frames.framing import Framing
from gateway.protocols.frames.messages import Ask, Listen, Values, Write, filled, listed
from gateway.protocols.frames.patterns import check_pattern, longest_match
from gateway.protocols.frames.presets import written_out
from gateway.protocols.unsolicited import UnsolicitedFrame
from gateway.values.numerals import Scalar

T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class Frames:
    """Settings of a `frames` device: its framing, and its frames.

    `send_framing` is for devices whose requests have another framing than their replies.
    """

    protocol: Literal["frames"] = "frames"
    framing: Framing
    send_framing: Framing | None = None
    listen: Mapping[str, Listen] = field(default_factory=dict)
    ask: Mapping[str, Ask] = field(default_factory=dict)
    write: Mapping[str, Write] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._check_framings()
        longest = written_out(self.framing).longest
        if not (self.listen or self.ask or self.write):
            raise ConfigError("it needs at least one of listen, ask and write")
        for text in self._patterns():
            check_pattern(text, longest)
        for text in self._templates():
            self._check_sent(text)
        self._check_names()

    @property
    def timing(self) -> Timing:
        """Default times; the silence lets an unsolicited frame end.

        Where a gap may end a reply, each request takes this gap longer.
        """
        framing = written_out(self.framing)
        gap = 0.0
        if framing.ends_by_gap:
            gap = framing.gap_timeout or 0.0
        return Timing(reply_timeout=0.5 + gap, turnaround=0.02 + gap, silence=0.01)

    @property
    def listened(self) -> frozenset[str]:
        """The fields of unsolicited frames."""
        return frozenset(name for one in self.listen.values() for name in one.fields)

    @property
    def asked(self) -> Mapping[str, str]:
        """The fields that are polled, each with the name of its request."""
        return {name: request for request, one in self.ask.items() for name in one.fields}

    def field_of(self, address: str) -> Field:
        """Returns the field of an address. Raises `ConfigError` with the names of all fields."""
        for name, found in self._fields():
            if name == address:
                return found
        raise ConfigError(f"{address!r} is no field of this device: it has {listed(self._names())}")

    def codec(self) -> FrameCodec:
        """Returns the codec of one transaction."""
        return FrameCodec(self.framing, self.send_framing)

    def reader(self, *, quiet: bool) -> FrameReader:
        """Returns the reader for unsolicited frames. `quiet`: the line is silent now."""
        return FrameReader(self.framing, quiet=quiet)

    def cost(self, request: str) -> Cost:
        """Returns the characters of a request and of its longest reply."""
        one = self.ask[request]
        frame = self._send.encode(octets(one.send))
        return Cost(len(frame), self._longest_reply(one.match, one.refused))

    def write_cost(self, name: str) -> Cost:
        """Returns the characters of the longest write and of its longest reply."""
        one, send = self.write[name], self._send
        around = one.frame(b"")
        most = send.longest - len(around)
        value = (most if one.value.widest is None else one.value.widest) * (1 + send.conversion)
        reply = 0 if one.match is None else self._longest_reply(one.match, one.refused)
        return Cost(len(send.encode(around)) + value, reply)

    def decode(self, frame: bytes) -> UnsolicitedFrame | None:
        """Decodes an unsolicited frame; None for a frame without an entry in `listen`.

        The reply confirms the frame to the device: a frame with a damaged field gets none.
        """
        for name, one in self.listen.items():
            values = one.values(frame)
            if values is not None:
                good = not any(isinstance(value, Garbled) for value in values.values())
                return UnsolicitedFrame(name, values, one.answer_to(frame) if good else None)
        return None

    async def read(self, talk: Talk[bytes], request: str) -> Values:
        """Returns the fields of the reply, each a value or the damage that hides it.

        Raises `Refused`, `NoReply`, `Garbled`, `LineDown`.
        """
        one = self.ask[request]
        reply = self._longest_reply(one.match, one.refused)
        frame = octets(one.send)
        return await talk.ask(frame, reply, _without_echo(talk, frame, one.answers))

    def put(self, name: str, value: Scalar) -> bytes:
        """Returns the bytes of a value in the frame that writes it.

        Raises `BadValue`, also for bytes that the framing cannot carry: before anything is sent.
        """
        one = self.write[name]
        raw = one.value.put(value)
        self._send.encode(one.frame(raw))
        return raw

    async def tell(self, talk: Talk[bytes], name: str, raw: bytes) -> bool:
        """Writes bytes from `put`. Returns True when the device acknowledged them, False where
        it never does. Raises as `read`.
        """
        one = self.write[name]
        frame = one.frame(raw)
        if one.match is None:
            await talk.tell(frame)
            return False
        reply = self._longest_reply(one.match, one.refused)
        return await talk.ask(frame, reply, _without_echo(talk, frame, one.answers))

    @property
    def _send(self) -> Framing:
        return written_out(self.framing if self.send_framing is None else self.send_framing)

    def _longest_reply(self, *patterns: str | None) -> int:
        """Returns the characters of the longest frame that one of the patterns matches."""
        framing = written_out(self.framing)
        taken = (longest_match(text, framing.longest) for text in patterns if text is not None)
        return framing.on_line(framing.length or max(taken))

    def _check_framings(self) -> None:
        for name, framing in (("framing", self.framing), ("send_framing", self.send_framing)):
            try:
                written_out(framing or self.framing)
            except ConfigError as error:
                raise ConfigError(f"{name}: {error}") from None

    def _patterns(self) -> Iterator[str]:
        yield from (one.match for one in self.listen.values())
        replies = [(one.match, one.refused) for one in self.ask.values()]
        writes = [(one.match, one.refused) for one in self.write.values()]
        for pair in (*replies, *writes):
            yield from (text for text in pair if text is not None)

    def _templates(self) -> Iterator[str]:
        yield from (one.answer for one in self.listen.values() if one.answer is not None)
        yield from (one.send for one in self.ask.values())
        yield from (one.send for one in self.write.values())

    def _check_sent(self, text: str) -> None:
        try:
            self._send.encode(filled(text, lambda _: b""))
        except BadValue as error:
            raise ConfigError(f"{text!r} cannot be sent: {error}") from None

    def _fields(self) -> Iterator[tuple[str, Field]]:
        for heard in self.listen.values():
            yield from heard.fields.items()
        for asked in self.ask.values():
            yield from asked.fields.items()
        yield from ((name, one.value) for name, one in self.write.items())

    def _names(self) -> list[str]:
        return sorted({name for name, _ in self._fields()})

    def _check_names(self) -> None:
        """Checks that a field has one meaning: at most one request, and one kind of values."""
        for name in self._names():
            if not NAME.match(name):
                raise ConfigError(f"write {name!r}: letters, digits and _, no digit first")
            requests = [request for request, one in self.ask.items() if name in one.fields]
            if len(requests) > 1:
                raise ConfigError(f"{name} is a field of {listed(requests)}: keep one of them")
            kinds = {found.kind for other, found in self._fields() if other == name}
            if len(kinds) > 1:
                raise ConfigError(f"{name} cannot be {' and '.join(sorted(kinds))} at once")


def _without_echo(
    talk: Talk[bytes], request: bytes, answers: Callable[[bytes], T | None]
) -> Callable[[bytes], T | None]:
    """Wraps `answers`: skips the echo of the request once while the line may echo."""
    echo = request if talk.may_echo else None

    def answer(frame: bytes) -> T | None:
        nonlocal echo
        if frame == echo:
            echo = None
            return None
        return answers(frame)

    return answer
