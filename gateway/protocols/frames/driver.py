"""The driver of a device without a protocol: its requests are areas, its fields addresses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from gateway.protocols.driver import Address, Area, Cost, Span, Talk, Timing, Traits, Unit
from gateway.protocols.frames.codec import FrameCodec
from gateway.protocols.frames.device import Frames
from gateway.protocols.frames.listener import Listener
from gateway.protocols.typed_fields import TypedField
from gateway.values.numerals import Scalar

LISTENED, WRITTEN = "listened", "written"


@dataclass(frozen=True, slots=True)
class WrittenField:
    """A field that can be written: the bytes of a value within its frame."""

    settings: Frames
    name: str

    def put(self, value: Scalar) -> bytes:
        """Returns its bytes. Raises `BadValue`, also for bytes that the framing cannot carry."""
        return self.settings.put(self.name, value)

    def take(self, raw: bytes) -> Scalar:
        """Returns the value of bytes from `put`. Raises `Garbled`."""
        return self.settings.write[self.name].value.take(raw)


@dataclass(frozen=True, slots=True)
class FrameDriver:
    """One area for each request, one for unsolicited fields, one for fields that are only written.

    The units of a read are the values of the fields, or the `Garbled` that hides one; the units
    of a write are the bytes of the value in its frame.
    """

    settings: Frames
    areas: Mapping[str, Area] = field(init=False, repr=False)
    _requests: Mapping[str, str] = field(init=False, repr=False)  # by area
    _names: Mapping[str, tuple[str, ...]] = field(init=False, repr=False)  # fields, by area
    _places: Mapping[str, Address] = field(init=False, repr=False)  # by field

    station: ClassVar = 0  # devices without a protocol have no number
    traits: ClassVar = Traits(baudrate=9600, format="8N1", numbered=False)

    def __post_init__(self) -> None:
        settings = self.settings
        requests = {f"ask {request}": request for request in settings.ask}
        listened = [name for one in settings.listen.values() for name in one.fields]
        names: dict[str, tuple[str, ...]] = {
            area: tuple(settings.ask[request].fields) for area, request in requests.items()
        }
        names[LISTENED] = tuple(dict.fromkeys(n for n in listened if n not in settings.asked))
        known = {*listened, *settings.asked}
        names[WRITTEN] = tuple(name for name in settings.write if name not in known)
        areas = {
            area: Area(area, Unit.WORD, 0, len(inside) - 1, readable=area in requests)
            for area, inside in names.items()
        }
        places = {
            name: Address(area, number)
            for area, inside in names.items()
            for number, name in enumerate(inside)
        }
        for attribute, value in (
            ("areas", areas),
            ("_requests", requests),
            ("_names", names),
            ("_places", places),
        ):
            object.__setattr__(self, attribute, value)

    @property
    def protocol(self) -> str:
        return self.settings.protocol

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
        """Finds the field with this name. Raises `ConfigError` with the names of all fields."""
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
        """Returns the cost of the whole request, also for some of its fields."""
        request = self._requests.get(span.area)
        return None if request is None else self.settings.cost(request)

    def write_cost(self, span: Span) -> Cost | None:
        name = self.spell(Address(span.area, span.start))
        if span.size != 1 or name not in self.settings.write:
            return None
        return self.settings.write_cost(name)

    def codec(self) -> FrameCodec:
        return self.settings.codec()

    async def read(self, talk: Talk[bytes], span: Span) -> Sequence[Any]:
        """Returns the value of each field, or the `Garbled` that hides it."""
        values = await self.settings.read(talk, self._requests[span.area])
        names = self._names[span.area][span.start : span.start + span.size]
        return [values[name] for name in names]

    async def write(self, talk: Talk[bytes], span: Span, units: Sequence[int]) -> bool:
        name = self.spell(Address(span.area, span.start))
        return await self.settings.tell(talk, name, bytes(units))

    async def resync(
        self,
        talk: Talk[bytes],
        outstanding: Span | None,
        probe_token: int,
        spans: Sequence[Span] = (),
    ) -> int:
        """Sends another request than the outstanding one; the same where there is no other.

        These replies do not name their request: a late reply to the same request is taken for
        the reply to this one.
        """
        late = None if outstanding is None else self._requests.get(outstanding.area)
        requests = list(self.settings.ask)
        others = [request for request in requests if request != late] or requests
        if others:
            await self.settings.read(talk, others[probe_token % len(others)])
        return 0
