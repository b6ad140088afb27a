"""A no-protocol device among those that are polled: its questions are areas, fields addresses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from gateway.protocols.driver import Address, Area, Cost, Span, Talk, Timing, Traits, Unit
from gateway.protocols.frames.codec import FrameCodec
from gateway.protocols.frames.device import Frames
from gateway.protocols.frames.listener import Listener
from gateway.protocols.typed_fields import TypedField
from gateway.values import Value

LISTENED, WRITTEN = "listened", "written"
_TRAITS = Traits(baudrate=9600, format="8N1", numbered=False)


@dataclass(frozen=True, slots=True)
class WrittenField:
    """A field that can be written: the bytes of a value within its frame."""

    settings: Frames
    name: str

    def put(self, value: Value) -> bytes:
        """Raises `BadValue`, also for what the framing cannot carry."""
        return self.settings.put(self.name, value)

    def take(self, raw: bytes) -> Value:
        """What bytes that were put mean. Raises `Garbled`."""
        return self.settings.write[self.name].value.take(raw)


@dataclass(frozen=True, slots=True)
class FrameDriver:
    """One area for each question, one for what comes unasked, one for what is only written.

    The units of a read are the fields' values, a `Garbled` for one that could not be read; those
    of a write are the bytes of the value in its frame.
    """

    settings: Frames
    areas: Mapping[str, Area] = field(init=False, repr=False)
    _questions: Mapping[str, str] = field(init=False, repr=False)  # by area
    _names: Mapping[str, tuple[str, ...]] = field(init=False, repr=False)  # fields, by area
    _places: Mapping[str, Address] = field(init=False, repr=False)  # by field

    def __post_init__(self) -> None:
        settings = self.settings
        questions = {f"ask {question}": question for question in settings.ask}
        listened = [name for one in settings.listen.values() for name in one.fields]
        names: dict[str, tuple[str, ...]] = {
            area: tuple(settings.ask[question].fields) for area, question in questions.items()
        }
        names[LISTENED] = tuple(dict.fromkeys(n for n in listened if n not in settings.asked))
        known = {*listened, *settings.asked}
        names[WRITTEN] = tuple(name for name in settings.write if name not in known)
        areas = {
            area: Area(area, Unit.WORD, 0, len(inside) - 1, readable=area in questions)
            for area, inside in names.items()
        }
        places = {
            name: Address(area, number)
            for area, inside in names.items()
            for number, name in enumerate(inside)
        }
        for attribute, value in (
            ("areas", areas),
            ("_questions", questions),
            ("_names", names),
            ("_places", places),
        ):
            object.__setattr__(self, attribute, value)

    @property
    def protocol(self) -> str:
        return self.settings.protocol

    @property
    def station(self) -> int:
        """No-protocol devices have no number; nobody else is on their side of the port."""
        return 0

    @property
    def traits(self) -> Traits:
        return _TRAITS

    @property
    def timing(self) -> Timing:
        return self.settings.timing

    @property
    def sends_unsolicited(self) -> bool:
        return bool(self.settings.listen)

    @property
    def unsolicited(self) -> frozenset[str]:
        return self.settings.listened

    def unsolicited_only(self, span: Span) -> bool:
        return span.area == LISTENED

    def listener(self, now: float) -> Listener:
        return Listener(self.settings, now)

    def address(self, text: str) -> Address:
        """A tag's address is the name of a field. Raises `ConfigError` saying which there are."""
        self.settings.field_of(text)
        return self._places[text]

    def spell(self, address: Address) -> str:
        return self._names[address.area][address.number]

    def typed_field(self, address: Address) -> TypedField:
        name = self.spell(address)
        found, writable = self.settings.field_of(name), name in self.settings.write
        return TypedField(
            type=found.value_type,
            shape=WrittenField(self.settings, name) if writable else found,
            polled=name in self.settings.asked,
            unsolicited=name in self.settings.listened,
            writable=writable,
            event_hint="events are fields under `listen`",
            write_hint=f"`write: {{{name}: ...}}`",
        )

    def cost(self, span: Span) -> Cost | None:
        """That of the whole question, however few of its fields are wanted."""
        question = self._questions.get(span.area)
        return None if question is None else self.settings.cost(question)

    def write_cost(self, span: Span) -> Cost | None:
        name = self.spell(Address(span.area, span.start))
        if span.size != 1 or name not in self.settings.write:
            return None
        return self.settings.write_cost(name)

    def codec(self) -> FrameCodec:
        return self.settings.codec()

    async def read(self, talk: Talk[bytes], span: Span) -> Sequence[Any]:
        """Each field's value, or the `Garbled` that says why there is none."""
        values = await self.settings.read(talk, self._questions[span.area])
        names = self._names[span.area][span.start : span.start + span.size]
        return [values[name] for name in names]

    async def write(self, talk: Talk[bytes], span: Span, units: Sequence[int]) -> bool:
        name = self.spell(Address(span.area, span.start))
        return await self.settings.tell(talk, name, bytes(units))

    async def resync(self, talk: Talk[bytes], doubt: Span | None, salt: int) -> int:
        """Another question than the doubtful one where there is one, else the same once more.

        Nothing in such frames says which request they answer: a late reply to the same question
        is taken for the reply to this one.
        """
        doubtful = None if doubt is None else self._questions.get(doubt.area)
        questions = list(self.settings.ask)
        others = [question for question in questions if question != doubtful] or questions
        if others:
            await self.settings.read(talk, others[salt % len(others)])
        return 0
