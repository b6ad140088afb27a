"""The Modbus codecs on real lines: chopped, noisy, echoing, shared, late."""

from contextlib import suppress

import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from gateway.errors import Evidence, Garbled
from gateway.protocols.checksums import crc16, lrc
from gateway.protocols.modbus import AsciiCodec, Frame, MbapCodec, RtuCodec, RtuSlaveCodec
from tests.vectors import Vector, vectors

MODERATE = settings(max_examples=150, deadline=None)
stations = st.integers(1, 247)
words = st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=40)
cuts = st.lists(st.integers(1, 9), min_size=1, max_size=300)


def read_words(station: int, count: int, wire: int = 0) -> Frame:
    return Frame(station, bytes((3,)) + wire.to_bytes(2, "big") + count.to_bytes(2, "big"))


def words_answer(station: int, values: list[int]) -> Frame:
    data = b"".join(value.to_bytes(2, "big") for value in values)
    return Frame(station, bytes((3, len(data))) + data)


def chopped(data: bytes, sizes: list[int]) -> list[bytes]:
    pieces = []
    for size in sizes:
        pieces.append(data[:size])
        data = data[size:]
    return [piece for piece in [*pieces, data] if piece]


def feed_all(
    codec: RtuCodec | RtuSlaveCodec | AsciiCodec | MbapCodec, pieces: list[bytes]
) -> list[Frame]:
    return [frame for piece in pieces for frame in codec.feed(piece)]


def asking(codec: RtuCodec | AsciiCodec, frame: Frame) -> RtuCodec | AsciiCodec:
    codec.encode(frame)
    return codec


def vector(name: str) -> Vector:
    return next(v for v in vectors(name.rsplit("-", 1)[0]) if v.id == name)


# ---- all framings ----------------------------------------------------------------------


@MODERATE
@given(stations, words, cuts, st.integers(0, 65535))
def test_an_answer_survives_any_chopping(
    station: int, values: list[int], sizes: list[int], number: int
) -> None:
    answer = words_answer(station, values)
    for codec in (RtuCodec(), AsciiCodec()):
        asking(codec, read_words(station, len(values)))
        wire = type(codec)().encode(answer)
        assert feed_all(codec, chopped(wire, sizes)) == [answer]
    numbered = answer._replace(transaction=number)
    assert feed_all(MbapCodec(), chopped(MbapCodec().encode(numbered), sizes)) == [numbered]


@MODERATE
@given(stations, words, cuts)
def test_a_request_survives_any_chopping(station: int, values: list[int], sizes: list[int]) -> None:
    data = words_answer(station, values).pdu[2:]
    frames = [
        read_words(station, 1),
        Frame(station, bytes((16, 0, 0, 0, len(values), len(data))) + data),
        Frame(0, bytes((15, 0, 0, 0, 8, 1, 0x55))),
        Frame(station, bytes((6, 0, 1, 2, 3))),
    ]
    wire = b"".join(RtuSlaveCodec(station).encode(frame) for frame in frames)
    assert feed_all(RtuSlaveCodec(station), chopped(wire, sizes)) == frames


@MODERATE
@given(st.lists(st.binary(max_size=40), max_size=8), stations)
def test_any_bytes_give_frames_garbled_or_silence(pieces: list[bytes], station: int) -> None:
    codecs = (RtuCodec(), RtuSlaveCodec(station), AsciiCodec(), MbapCodec())
    for codec in codecs:
        if not isinstance(codec, RtuSlaveCodec):
            codec.encode(read_words(station, 2))
        with suppress(Garbled):
            assert all(frame.pdu for frame in feed_all(codec, pieces))


# ---- RTU -------------------------------------------------------------------------------


@MODERATE
@given(stations, words, st.binary(min_size=1, max_size=12), st.binary(max_size=12), cuts)
def test_rtu_noise_before_and_after_does_not_hide_the_answer(
    station: int, values: list[int], before: bytes, after: bytes, sizes: list[int]
) -> None:
    # Noise that begins like the answer is waited for until the time-out: a retry, not a value.
    joint = before + bytes((station,))
    assume(all(joint[i : i + 2] != bytes((station, 3)) for i in range(len(joint))))
    answer = words_answer(station, values)
    wire = before + RtuCodec().encode(answer) + after
    codec = asking(RtuCodec(), read_words(station, len(values)))
    assert answer in feed_all(codec, chopped(wire, sizes))


@pytest.mark.parametrize("noise", ["00", "ff", "01", "03", "00 00 00", "01 01", "01 81 01 01 83"])
def test_rtu_noise_seen_on_real_lines_does_not_hide_the_answer(noise: str) -> None:
    request, answer = vector("modbus-rtu-001"), vector("modbus-rtu-002")
    codec = RtuCodec()
    codec.encode(Frame(1, bytes.fromhex(request.fields["pdu"])))
    heard = feed_all(codec, [bytes.fromhex(noise) + answer.frame])
    assert heard == [Frame(1, bytes.fromhex(answer.fields["pdu"]))]


@MODERATE
@given(stations, words, st.integers(0, 65535), cuts)
@example(1, [0], 0x0200, [7])  # all but one of the echo's characters: as long as the answer
def test_rtu_an_echo_does_not_hide_the_answer(
    station: int, values: list[int], wire: int, sizes: list[int]
) -> None:
    request = read_words(station, len(values), wire)
    answer = words_answer(station, values)
    codec = RtuCodec()
    stream = codec.encode(request) + RtuCodec().encode(answer)
    assert answer in feed_all(codec, chopped(stream, sizes))


def test_rtu_an_echo_that_begins_like_the_reply_is_recognised() -> None:
    # Register 0800h, four words: the echo reads 03 08, function and byte count of the answer.
    request, answer = read_words(1, 4, 0x0800), words_answer(1, [1, 2, 3, 4])
    exception = Frame(1, b"\x83\x02")
    for reply in (answer, exception):
        codec = RtuCodec()
        assert feed_all(codec, [codec.encode(request), RtuCodec().encode(reply)]) == [reply]


@MODERATE
@given(stations, stations, words, words, cuts)
def test_rtu_another_stations_answer_is_passed_on_as_such(
    station: int, other: int, values: list[int], others: list[int], sizes: list[int]
) -> None:
    frames = [words_answer(other, others), words_answer(station, values)]
    codec = asking(RtuCodec(), read_words(station, len(values)))
    stream = b"".join(RtuCodec().encode(frame) for frame in frames)
    assert feed_all(codec, chopped(stream, sizes)) == frames


@MODERATE
@given(stations, words, st.data())
def test_rtu_a_damaged_answer_is_garbled_and_never_read(
    station: int, values: list[int], data: st.DataObject
) -> None:
    wire = bytearray(RtuCodec().encode(words_answer(station, values)))
    place = data.draw(st.integers(3, len(wire) - 1))
    wire[place] ^= 1 << data.draw(st.integers(0, 7))
    codec = asking(RtuCodec(), read_words(station, len(values)))
    with pytest.raises(Garbled) as garbled:
        codec.feed(bytes(wire))
    assert garbled.value.evidence is Evidence.CHECKSUM


@MODERATE
@given(stations, words, st.data())
def test_rtu_a_truncated_answer_is_silence(
    station: int, values: list[int], data: st.DataObject
) -> None:
    wire = RtuCodec().encode(words_answer(station, values))
    codec = asking(RtuCodec(), read_words(station, len(values)))
    assert codec.feed(wire[: data.draw(st.integers(0, len(wire) - 1))]) == []


def test_rtu_damage_of_another_length_is_noise_before_the_answer() -> None:
    late = bytearray(RtuCodec().encode(words_answer(1, [7, 8, 9])))
    late[4] ^= 1
    answer = words_answer(1, [5])
    codec = asking(RtuCodec(), read_words(1, 1))
    assert codec.feed(bytes(late) + RtuCodec().encode(answer)) == [answer]


def test_rtu_a_frame_kept_in_a_plcs_registers_is_data() -> None:
    """A PLC that is a master too keeps answers of its own slaves in its registers."""
    stored = RtuCodec().encode(words_answer(1, [7]))
    stored += bytes(len(stored) % 2)
    late = RtuCodec().encode(Frame(1, bytes((3, len(stored) + 4)) + stored + bytes(4)))
    codec = asking(RtuCodec(), read_words(1, 1))
    heard = feed_all(codec, [late[i : i + 1] for i in range(len(late))])
    assert heard == [Frame(1, bytes((3, len(stored) + 4)) + stored + bytes(4))]


def test_rtu_an_endless_babble_is_forgotten() -> None:
    codec = asking(RtuCodec(), read_words(1, 1))
    for _ in range(50):
        assert codec.feed(bytes(range(2, 200))) == []
        assert len(codec._heard) <= 520  # private: bounded memory has no other sign
    assert codec.feed(RtuCodec().encode(words_answer(1, [5]))) == [words_answer(1, [5])]


@pytest.mark.parametrize("written", range(1, 20))
def test_rtu_a_slave_finds_requests_between_replies_of_others(written: int) -> None:
    """An answer to function 16 begins like a request, its CRC where the byte count would be."""
    request = read_words(1, 1)
    others = [
        read_words(2, 2),
        words_answer(2, [1, 2]),
        Frame(2, bytes((16, 0, 0, 0, written))),
    ]
    stream = b"".join(RtuSlaveCodec(2).encode(frame) for frame in [*others, request])
    frames = feed_all(RtuSlaveCodec(1), [stream])
    assert [frame for frame in frames if frame.station == 1] == [request]


def test_rtu_an_unknown_function_ends_with_its_crc() -> None:
    body = bytes((1, 0x2B, 0x0E, 1, 0))
    codec = RtuSlaveCodec(1)
    assert feed_all(codec, [body[:3], body[3:] + crc16(body)]) == [Frame(1, body[1:])]


# ---- ASCII -----------------------------------------------------------------------------


@MODERATE
@given(stations, words, st.binary(max_size=12), st.binary(max_size=12), cuts)
def test_ascii_noise_before_and_after_does_not_hide_the_answer(
    station: int, values: list[int], before: bytes, after: bytes, sizes: list[int]
) -> None:
    answer = words_answer(station, values)
    codec = asking(AsciiCodec(), read_words(station, len(values)))
    wire = before + AsciiCodec().encode(answer) + after
    assert answer in feed_all(codec, chopped(wire, sizes))


def test_ascii_a_colon_begins_another_frame() -> None:
    good = vector("modbus-ascii-002")
    frame = Frame(1, bytes.fromhex(good.fields["pdu"]))
    assert AsciiCodec().feed(good.frame[:9] + good.frame) == [frame]


@pytest.mark.parametrize("damage", [b"G", b" ", b"0"])
def test_ascii_a_damaged_answer_is_garbled(damage: bytes) -> None:
    request, answer = vector("modbus-ascii-001"), vector("modbus-ascii-002")
    codec = AsciiCodec()
    assert codec.encode(Frame(1, bytes.fromhex(request.fields["pdu"]))) == request.frame
    with pytest.raises(Garbled) as garbled:
        codec.feed(answer.frame[:-3] + damage + answer.frame[-2:])
    assert garbled.value.evidence is Evidence.CHECKSUM


def test_ascii_a_frame_before_the_damage_is_returned() -> None:
    codec = asking(AsciiCodec(), read_words(1, 1))
    wire = AsciiCodec().encode(words_answer(1, [1]))
    assert codec.feed(wire.replace(b":01", b":02")) == []  # not the answer: noise
    assert codec.feed(wire + wire[:-4] + b"00\r\n") == [words_answer(1, [1])]
    with pytest.raises(Garbled):
        codec.feed(b"")


def test_ascii_digits_are_digits_alone() -> None:
    """`bytes.fromhex` would take blanks between them."""
    body = bytes((1, 3, 2, 0, 7))
    text = b":" + (body + bytes((lrc(body),))).hex(" ", 3).upper().encode() + b"\r\n"
    assert AsciiCodec().feed(text) == []


# ---- Modbus TCP ------------------------------------------------------------------------


def test_mbap_several_frames_come_in_one_piece() -> None:
    frames = [Frame(1, b"\x03\x02\x00\x07", number) for number in (1, 2, 65535)]
    wire = b"".join(MbapCodec().encode(frame) for frame in frames)
    assert MbapCodec().feed(wire) == frames


@pytest.mark.parametrize("header", ["0001 0001 0003 01", "0001 0000 0001 01", "0001 0000 00ff 01"])
def test_mbap_a_header_of_something_else_is_garbled(header: str) -> None:
    with pytest.raises(Garbled):
        MbapCodec().feed(bytes.fromhex(header))


def test_mbap_frames_before_the_damage_are_returned() -> None:
    codec, frame = MbapCodec(), Frame(1, b"\x83\x02", 9)
    assert codec.feed(codec.encode(frame) + b"HTTP/1.1") == [frame]
    with pytest.raises(Garbled):
        codec.feed(b"\r\n")
