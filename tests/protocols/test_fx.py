"""The FX programming port: published frames, and the driver and the station against a peer."""

from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.cli.line import direct
from gateway.config import ConfigErrors, built
from gateway.errors import Garbled, Refused
from gateway.protocols.driver import Cost, Span, Unit
from gateway.protocols.fx.codec import FxCodec, Reply, Request, encode
from gateway.protocols.fx.driver import Fx
from gateway.stations.fx import FxStation
from gateway.tags import Quality, WriteResult
from tests.doubles import Wire, in_pieces, result_of
from tests.protocols.fx_peer import WORDS, Peer
from tests.sim.virtual import on_virtual_time

FX = Fx()
# Published examples: gkong.com (read, data, write), and the frame that forces Y0 on.
READ_D123 = bytes.fromhex("02 30 31 30 46 36 30 34 03 37 34")
DATA_3584 = bytes.fromhex("02 33 35 38 34 03 44 37")  # printed there with D6, against its rule
WRITE_D123 = bytes.fromhex("02 31 31 30 46 36 30 34 33 34 31 32 43 44 41 42 03 34 39")
FORCE_Y0 = bytes.fromhex("02 37 30 30 30 35 03 46 46")


def test_the_published_frames() -> None:
    assert encode(Request(b"0", b"10F604")) == READ_D123
    assert FxCodec().feed(DATA_3584) == [Reply(bytes.fromhex("3584"))]
    peer = Peer()
    wire = Wire(FX, peer.answer)
    result_of(FX.read(wire, Span("D", 123, 2)))
    result_of(FX.write(wire, Span("D", 123, 2), [0x1234, 0xABCD]))
    result_of(FX.write(wire, Span("Y", 0, 1), [1]))
    assert wire.sent == [READ_D123, WRITE_D123, FORCE_Y0]
    assert (peer.word("D", 123), peer.word("D", 124)) == (0x1234, 0xABCD)


@st.composite
def spans(draw: st.DrawFn) -> Span:
    area = FX.areas[draw(st.sampled_from(sorted(FX.areas)))]
    start = draw(st.integers(area.first, area.last))
    return Span(area.name, start, draw(st.integers(1, min(600, area.last + 1 - start))))


def kept(peer: Peer, span: Span) -> list[int]:
    letters = span.area.rstrip("0123456789")
    numbers = range(span.start, span.start + span.size)
    if letters in WORDS:
        return [peer.word(letters, number) for number in numbers]
    return [peer.bit(letters, number) for number in numbers]


@settings(max_examples=150)
@given(st.data(), st.integers(1, 7))
def test_what_is_written_is_in_the_plc_and_nothing_else_and_is_read_at_its_cost(
    data: st.DataObject, pieces: int
) -> None:
    span = data.draw(spans())
    top = FX.areas[span.area].unit.largest
    units = data.draw(st.lists(st.integers(0, top), min_size=span.size, max_size=span.size))
    if FX.cost(span) is None:
        assert FX.write_cost(span) is None
        return
    peer = Peer()
    around = data.draw(spans())
    letters = around.area.rstrip("0123456789")
    one = data.draw(st.integers(0, 1))
    (peer.set_word if letters in WORDS else peer.set_bit)(letters, around.start, one)

    def answer(request: bytes) -> list[bytes]:
        return [piece for one in peer.answer(request) for piece in in_pieces(one, pieces)]

    wire = Wire(FX, answer)
    assert result_of(FX.write(wire, span, units))
    assert wire.cost == FX.write_cost(span)
    assert kept(peer, span) == units
    if not span.overlaps(Span(around.area, around.start, 1)):
        assert kept(peer, Span(around.area, around.start, 1)) == [one]
    wire = Wire(FX, answer)
    assert list(result_of(FX.read(wire, span))) == units
    assert wire.cost == FX.cost(span)


@settings(max_examples=150)
@given(st.data())
def test_the_simulated_plc_answers_as_the_peer(data: st.DataObject) -> None:
    peer, station = Peer(), FxStation()
    span = data.draw(spans())
    if FX.cost(span) is None or FX.writes_around(span):  # the peer has bits that a PLC lacks
        return
    top = FX.areas[span.area].unit.largest
    units = data.draw(st.lists(st.integers(0, top), min_size=span.size, max_size=span.size))

    def both(request: bytes) -> list[bytes]:
        replies = peer.answer(request)
        assert station.hear(request, 0.0) == replies
        return replies

    result_of(FX.write(Wire(FX, both), span, units))
    result_of(FX.read(Wire(FX, both), span))


def test_the_simulated_plc_refuses_what_it_lacks() -> None:
    station = FxStation()
    for frame in (Request(b"0", b"180004"), Request(b"7", b"0040"), Request(b"E", b"00100004")):
        assert station.hear(encode(frame), 0.0) == [b"\x15"]
    assert station.hear(READ_D123[:-1] + b"5", 0.0) == [b"\x15"]  # a wrong sum
    assert station.hear(b"\x05", 0.0) == [b"\x06"]
    with pytest.raises(Refused, match="NAK"):
        result_of(FX.read(Wire(FX, lambda _: [b"\x15"]), Span("D", 0, 1)))
    with pytest.raises(Refused, match="NAK"):
        result_of(FX.write(Wire(FX, lambda _: [b"\x15"]), Span("D", 0, 1), [1]))


@given(st.integers(1, 8))
def test_frames_are_found_in_pieces_behind_noise_and_echo(size: int) -> None:
    codec, found = FxCodec(), list[object]()
    for piece in in_pieces(b"\x00A" + READ_D123 + DATA_3584 + WRITE_D123 + b"\x06", size):
        found += codec.feed(piece)
    assert found == [Reply(bytes.fromhex("3584")), Reply()]


@pytest.mark.parametrize(
    "data",
    [
        b"A\x06",  # noise holds any character: this is no acknowledgement
        b"\x02\x06",
        DATA_3584[:-1] + b"6",
        b"\x02" + b"0" * 200,
        b"\x0235G4\x0300",
    ],
)
def test_what_is_damaged_is_no_reply(data: bytes) -> None:
    with pytest.raises(Garbled):
        FxCodec().feed(data)
    codec = FxCodec()
    assert codec.feed(DATA_3584 + data) == [Reply(bytes.fromhex("3584"))]
    with pytest.raises(Garbled):
        codec.feed(b"")


@given(st.binary(max_size=300))
def test_any_bytes_are_frames_damage_or_nothing(data: bytes) -> None:
    codec = FxCodec()
    with suppress(Garbled):
        assert all(isinstance(one, Reply) for one in codec.feed(data))
    for reply in FxStation().hear(data, 0.0):
        assert reply in (b"\x06", b"\x15") or reply.startswith(b"\x02")


def test_shapes_of_replies_tell_reads_and_writes_apart() -> None:
    assert FX.reply_shape(Span("D", 0, 2)) == FX.reply_shape(Span("D", 50, 2)) == 4
    assert FX.write_shapes(Span("D", 0, 2), [1, 2]) == ("ack",)
    assert FX.write_shapes(Span("M", 3, 2), [1, 1]) == (1, "ack")
    assert FX.cost(Span("D", 0, 33)) is None
    assert FX.write_cost(Span("M", 7, 1)) == Cost(9, 1)
    assert FX.areas["C32"].unit is Unit.DWORD


TAGS = {
    "speed": {"address": "D100", "write": {"verify": True}},
    "run": {"address": "Y7", "write": True},
    "ready": {"address": "M8000"},
    "total": {"address": "C200"},
}


@on_virtual_time
async def test_it_is_polled_and_written_on_a_simulated_line() -> None:
    line = {"port": "simulator", "devices": {"press": {"protocol": "fx", "tags": TAGS}}}
    config = built({"lines": {"hall": line}})
    assert (config.lines[0].serial.baudrate, config.lines[0].serial.format) == (9600, "7E1")
    tags = {tag.name: tag for tag in config.devices[0].tags}
    samples = await direct.read(config, list(tags.values()))
    assert {sample.quality for sample in samples} == {Quality.GOOD}
    ends = await direct.write_group(config, [(tags["speed"], 42), (tags["run"], True)])
    assert [end.value for end in ends if isinstance(end, WriteResult)] == [42, True]


@pytest.mark.parametrize(
    ("device", "says"),
    [
        ({"tags": {"a": {"address": "D1024"}}}, "D goes from D0 to D1023 and D8000 to D8255"),
        ({"tags": {"a": {"address": "X8"}}}, "numbered in octal"),
        ({"station": 1, "tags": {}}, "station: no setting of a fx device"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, device: dict[str, object], says: str) -> None:
    line = {"port": "/dev/ttyS9", "devices": {"press": {"protocol": "fx", **device}}}
    with pytest.raises(ConfigErrors) as caught:
        built({"lines": {"hall": line}}, tmp_path)
    assert says in str(caught.value)


def test_a_line_has_one_fx(tmp_path: Path) -> None:
    device = {"protocol": "fx", "tags": {"a": {"address": "D1"}}}
    line = {"port": "/dev/ttyS9", "devices": {"one": device, "two": device}}
    with pytest.raises(ConfigErrors, match="fx has no station numbers: give it a line of its own"):
        built({"lines": {"hall": line}}, tmp_path)
