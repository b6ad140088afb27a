"""A device without a protocol of ours: what it says, what it is asked, what it is told.

Its frames are named in the file. `listen`: it speaks when it likes. `ask`: it answers a request.
`write`: it takes a value. A tag's address is the name of a field of these frames; what is
written is named as the tag that writes it.
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
from gateway.values import Value

T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class Frames:
    """Settings of a `frames` device: how frames are bounded, and which there are.

    `send_framing` is for devices that are spoken to in another framing than they speak.
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
            raise ConfigError("say what it sends (listen), is asked (ask) or takes (write)")
        for text in self._patterns():
            check_pattern(text, longest)
        for text in self._templates():
            self._check_sent(text)
        self._check_names()

    @property
    def timing(self) -> Timing:
        """Customary times; the silence lets a device finish that speaks unasked.

        Where only a gap ends a reply, that gap is waited for each time.
        """
        framing = written_out(self.framing)
        gap = 0.0
        if not framing.mark and framing.length is None:
            gap = framing.gap_timeout or 0.0
        return Timing(reply_timeout=0.5 + gap, turnaround=0.02 + gap, silence=0.01)

    @property
    def listened(self) -> frozenset[str]:
        """The fields that come unasked."""
        return frozenset(name for one in self.listen.values() for name in one.fields)

    @property
    def asked(self) -> Mapping[str, str]:
        """The fields that are asked for, each with the name of its question."""
        return {name: question for question, one in self.ask.items() for name in one.fields}

    def field_of(self, address: str) -> Field:
        """The field that a tag's address names. Raises `ConfigError` saying which there are."""
        for name, found in self._fields():
            if name == address:
                return found
        raise ConfigError(f"{address!r} is no field of this device: it has {listed(self._names())}")

    def codec(self) -> FrameCodec:
        """For one turn: the device is asked or told something."""
        return FrameCodec(self.framing, self.send_framing)

    def reader(self, *, quiet: bool) -> FrameReader:
        """For listening as long as the port is open. `quiet`: the line is known to be silent."""
        return FrameReader(self.framing, quiet=quiet)

    def cost(self, question: str) -> Cost:
        """The characters of a question and of the longest reply to it."""
        one = self.ask[question]
        request = self._send.encode(octets(one.send))
        return Cost(len(request), self._longest_reply(one.match, one.refused))

    def write_cost(self, name: str) -> Cost:
        """The characters of the longest write and of the longest reply to it."""
        one, send = self.write[name], self._send
        around = one.frame(b"")
        most = send.longest - len(around)
        value = (most if one.value.widest is None else one.value.widest) * (1 + send.conversion)
        reply = 0 if one.match is None else self._longest_reply(one.match, one.refused)
        return Cost(len(send.encode(around)) + value, reply)

    def hear(self, frame: bytes) -> UnsolicitedFrame | None:
        """What an unasked frame says; None for a frame that `listen` does not know.

        An answer tells the device that it was understood: there is none where a field was not.
        """
        for name, one in self.listen.items():
            values = one.values(frame)
            if values is not None:
                good = not any(isinstance(value, Garbled) for value in values.values())
                return UnsolicitedFrame(name, values, one.answer_to(frame) if good else None)
        return None

    async def read(self, talk: Talk[bytes], question: str) -> Values:
        """Ask. The fields of the reply, each a value or why there is none.

        Raises `Refused`, `NoReply`, `Garbled`, `LineDown`.
        """
        one = self.ask[question]
        reply = self._longest_reply(one.match, one.refused)
        frame = octets(one.send)
        return await talk.ask(frame, reply, _but_an_echo(talk, frame, one.answers))

    def put(self, name: str, value: Value) -> bytes:
        """A value's own bytes in the frame that writes it.

        Raises `BadValue`, also for what the framing cannot carry: before the line is taken.
        """
        one = self.write[name]
        raw = one.value.put(value)
        self._send.encode(one.frame(raw))
        return raw

    async def tell(self, talk: Talk[bytes], name: str, raw: bytes) -> bool:
        """Write what `put` has made. True when the device acknowledged it, False where it never
        does. Raises as `read`.
        """
        one = self.write[name]
        frame = one.frame(raw)
        if one.match is None:
            await talk.tell(frame)
            return False
        reply = self._longest_reply(one.match, one.refused)
        return await talk.ask(frame, reply, _but_an_echo(talk, frame, one.answers))

    @property
    def _send(self) -> Framing:
        return written_out(self.framing if self.send_framing is None else self.send_framing)

    def _longest_reply(self, *patterns: str | None) -> int:
        """The characters of the longest frame that one of the patterns takes."""
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
        """A field has one meaning: one question at most asks for it, its values are of one kind."""
        for name in self._names():
            if not NAME.match(name):
                raise ConfigError(f"write {name!r}: letters, digits and _, no digit first")
            asking = [question for question, one in self.ask.items() if name in one.fields]
            if len(asking) > 1:
                raise ConfigError(f"{name} is a field of {listed(asking)}: one of them asks for it")
            kinds = {found.kind for other, found in self._fields() if other == name}
            if len(kinds) > 1:
                raise ConfigError(f"{name} cannot be {' and '.join(sorted(kinds))} at once")


def _but_an_echo(
    talk: Talk[bytes], said: bytes, answers: Callable[[bytes], T | None]
) -> Callable[[bytes], T | None]:
    """`answers`, but for our own words while they may come back: the device must say them again."""
    echo = said if talk.may_echo else None

    def answer(frame: bytes) -> T | None:
        nonlocal echo
        if frame == echo:
            echo = None
            return None
        return answers(frame)

    return answer
