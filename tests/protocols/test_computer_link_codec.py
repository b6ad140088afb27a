"""Computer Link blocks, against the checked vectors of the Liyan manual's examples."""

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gateway.errors import Evidence, Garbled
from gateway.protocols.computer_link import Ack, Enquiry, Frame, LinkCodec, Nak, Text
from tests.protocols.computer_link_peer import PROCEDURES, Procedure
from tests.vectors import Vector, vectors

LINK = vectors("fxlink")
# The gateway never sends EOT, which resets the sequence of the PLC.
VALID = [vector for vector in LINK if vector.valid and vector.fields.get("kind") != "EOT"]
REPLIES = [vector for vector in VALID if vector.direction == "response"]
REQUESTS = [vector for vector in VALID if "command" in vector.fields]


def codec(vector: Vector) -> LinkCodec:
    return LinkCodec(vector.fields["format"], vector.fields.get("sum_check", True))


def frame_of(vector: Vector) -> Frame:
    fields = vector.fields
    match fields.get("kind"):
        case None:
            wait, area = fields["wait"], fields["area"]
            return Enquiry(fields["station"], fields["command"], area, wait, fields["pc"])
        case "STX":
            return Text(fields["station"], fields["data"], fields["pc"])
        case "ACK":
            return Ack(fields["station"], fields.get("pc", "FF"))
        case "NAK":
            return Nak(fields["station"], fields.get("error", ""), fields.get("pc", "FF"))
    raise AssertionError(vector)


@pytest.mark.parametrize("vector", VALID, ids=repr)
def test_a_frame_is_written_as_in_the_vector(vector: Vector) -> None:
    assert codec(vector).encode(frame_of(vector)).hex(" ") == vector.frame.hex(" ")


@pytest.mark.parametrize("vector", REPLIES, ids=repr)
def test_a_reply_is_read_whole_byte_by_byte_and_with_bytes_after_it(vector: Vector) -> None:
    expected = [frame_of(vector)]
    assert codec(vector).feed(vector.frame) == expected
    by_byte = codec(vector)
    assert [frame for byte in vector.frame for frame in by_byte.feed(bytes([byte]))] == expected
    assert codec(vector).feed(b"\x00\xff\r\n" + vector.frame + b"\x02") == expected


@pytest.mark.parametrize("vector", REPLIES, ids=repr)
def test_no_piece_short_of_the_whole_is_a_reply(vector: Vector) -> None:
    for size in range(len(vector.frame)):
        assert codec(vector).feed(vector.frame[:size]) == []


@pytest.mark.parametrize("vector", REQUESTS, ids=repr)
def test_the_echo_of_a_request_is_that_request_and_no_reply(vector: Vector) -> None:
    reader = codec(vector)
    block = reader.encode(frame_of(vector))
    assert reader.feed(b"\x05" + block[:3]) == []
    assert reader.feed(block[3:] + block[:3]) == [frame_of(vector)]


@pytest.mark.parametrize("vector", REQUESTS, ids=repr)
def test_another_computers_request_is_noise(vector: Vector) -> None:
    reader = codec(vector)
    reader.encode(Enquiry(9, "WR", "D123401"))
    assert reader.feed(vector.frame) == []


def test_an_echo_before_the_reply_leaves_the_reply() -> None:
    request, reply = (
        next(v for v in LINK if v.id == name) for name in ("fxlink-001", "fxlink-057")
    )
    reader = codec(request)
    reader.encode(frame_of(request))
    assert reader.feed(request.frame + reply.frame) == [frame_of(request), frame_of(reply)]


@pytest.mark.parametrize("vector", [v for v in REPLIES if v.fields.get("sum_check")], ids=repr)
def test_a_reply_with_any_character_changed_is_never_a_reply(vector: Vector) -> None:
    for at in range(1, len(vector.frame)):
        damaged = bytearray(vector.frame)
        damaged[at] ^= 1
        try:
            frames = codec(vector).feed(bytes(damaged))
        except Garbled:
            continue
        assert frames == []


def test_1_3_3_a_wrong_sum_is_garbled() -> None:
    reply = next(v for v in LINK if v.id == "fxlink-057").frame
    with pytest.raises(Garbled) as caught:
        LinkCodec().feed(reply[:-1] + b"8")
    assert caught.value.evidence is Evidence.CHECKSUM
    assert caught.value.data == reply[:-1] + b"8"


def test_a_reply_before_damage_is_handed_out_first() -> None:
    reply = next(v for v in LINK if v.id == "fxlink-057")
    reader = LinkCodec()
    assert reader.feed(reply.frame + reply.frame[:-1] + b"8") == [frame_of(reply)]
    with pytest.raises(Garbled):
        reader.feed(b"")


@pytest.mark.parametrize(
    ("heard", "read_as", "says"),
    [
        ((1, True), (4, True), "format 1"),
        ((1, True), (4, False), "sends a sum check"),
        ((4, True), (4, False), "sends a sum check"),
        ((4, False), (1, True), "no sum check"),
        ((4, False), (4, True), "no sum check"),
    ],
)
def test_a_reply_of_another_setting_names_the_setting(
    heard: Procedure, read_as: Procedure, says: str
) -> None:
    block = LinkCodec(*heard).encode(Text(5, "01101"))
    with pytest.raises(Garbled, match=says) as caught:
        LinkCodec(*read_as).feed(block + block)
    assert caught.value.evidence is Evidence.SHAPE


@pytest.mark.parametrize("frame", [Ack(5), Nak(5, "06")], ids=repr)
def test_a_format_1_acknowledgement_is_none_in_format_4(frame: Frame) -> None:
    block = LinkCodec(1).encode(frame)
    with pytest.raises(Garbled, match="CR LF is missing") as caught:
        LinkCodec(4).feed(block + block)
    assert caught.value.evidence is Evidence.SHAPE


def test_data_without_end_is_garbled() -> None:
    with pytest.raises(Garbled) as caught:
        LinkCodec().feed(b"\x0205FF" + b"0" * 257)
    assert caught.value.evidence is Evidence.TRUNCATED


def test_a_block_that_broke_off_does_not_hide_the_next() -> None:
    reply = next(v for v in LINK if v.id == "fxlink-057")
    assert LinkCodec().feed(reply.frame[:7] + reply.frame) == [frame_of(reply)]


def test_2_13_a_loopback_may_hold_any_printable_characters() -> None:
    text = "".join(map(chr, range(0x20, 0x7F)))
    for procedure in PROCEDURES:
        frame = Text(0, f"{len(text):02X}{text}")
        assert LinkCodec(*procedure).feed(LinkCodec(*procedure).encode(frame)) == [frame]


procedures = st.sampled_from(PROCEDURES)
stations = st.integers(0, 31)
answers = st.one_of(
    st.builds(
        Text, stations, st.text("0123456789ABCDEF", max_size=256), st.sampled_from(["FF", "FE"])
    ),
    st.builds(
        Text, stations, st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=256)
    ),
    st.builds(Ack, stations),
    st.builds(Nak, stations, st.sampled_from(["02", "03", "06", "07", "0A", "10", "18", "FF"])),
)
# Bytes that begin no block: a station that hears these knows them for noise at once.
noise = st.lists(
    st.sampled_from(b"\x00\x01\x03\x04\x0a\x0c\x0d09AFZ~\x7f\x80\xff"), max_size=12
).map(bytes)


@settings(max_examples=60)
@given(procedures, st.lists(st.tuples(noise, answers), max_size=4), st.lists(st.integers(1, 9)))
def test_blocks_survive_noise_and_any_chopping(
    procedure: Procedure, parts: list[tuple[bytes, Frame]], cuts: list[int]
) -> None:
    writer, reader = LinkCodec(*procedure), LinkCodec(*procedure)
    stream, bare = b"", False
    for junk, frame in parts:
        # Behind an answer without CR LF, digits make it a block whose STX is damaged.
        stream += (junk.lstrip(b"09AF") if bare else junk) + writer.encode(frame)
        bare = procedure[0] == 1 and not isinstance(frame, Text)
    heard: list[Frame] = []
    for cut in cuts:
        heard += reader.feed(stream[:cut])
        stream = stream[cut:]
    heard += reader.feed(stream)
    assert heard == [frame for _, frame in parts]


@given(stations, st.text("0123456789ABCDEF", min_size=1, max_size=8), st.booleans())
def test_a_block_whose_stx_has_one_wrong_bit_is_no_acknowledgement(
    station: int, data: str, sums: bool
) -> None:
    """It has no sum in format 1. It counted as an extra reply, and acknowledged a write."""
    block = LinkCodec(1, sums).encode(Text(station, data))
    with pytest.raises(Garbled):
        LinkCodec(1, sums).feed(b"\x06" + block[1:])
    assert LinkCodec(1, sums).feed(b"\x0605FF\x00\xff") == [Ack(5)]  # a glitch behind it


def outcome(procedure: Procedure, pieces: list[bytes]) -> tuple[list[Frame], str]:
    """Returns the blocks that a codec finds in a stream, and the damage at its end."""
    reader = LinkCodec(*procedure)
    frames: list[Frame] = []
    reader.encode(Enquiry(5, "BR", "M001005", 10))
    try:
        for piece in [*pieces, b""]:
            frames += reader.feed(piece)
    except Garbled as damage:
        return frames, f"{damage.evidence}"
    return frames, ""


line_bytes = st.lists(
    st.one_of(
        st.sampled_from(
            [b"\x02", b"\x03", b"\x05", b"\x06", b"\x15", b"\r\n", b"05FF", b"01", b"\x0205FF"]
        ),
        st.binary(max_size=3),
    ),
    max_size=20,
).map(b"".join)


@settings(max_examples=150)
@given(procedures, line_bytes)
@example((4, True), b"\x0605FF\r\r\n")
@example((1, True), b"\x0205FF\x03\r")
def test_any_bytes_are_blocks_damage_or_nothing_however_they_are_cut(
    procedure: Procedure, data: bytes
) -> None:
    whole = outcome(procedure, [data])
    frames, damage = outcome(procedure, [bytes([byte]) for byte in data])
    if procedure[0] == 1 and damage:  # an answer was whole until the data behind it arrived
        frames = frames[: len(whole[0])]
    assert (frames, damage) == whole
