"""No-protocol framing against the worked frames of the VB-1COM, RS, EX485LNK and K120S manuals."""

import re
from typing import Any, Literal

import pytest

from gateway.errors import BadValue, ConfigError, Garbled
from gateway.protocols.frames import FrameCodec, FrameReader, Framing
from gateway.protocols.frames.presets import written_out
from tests.vectors import Vector, vectors

VB_1COM = vectors("noproto-vb1com")
VALID = [vector for vector in VB_1COM if vector.valid]
DAMAGED = [vector for vector in VB_1COM if not vector.valid]
RS = vectors("noproto-rs")
EX485LNK = vectors("noproto-ex485lnk")
K120S = vectors("noproto-k120s")


def written(register: str) -> str:
    """A header or terminator register pair as the file writes it: leading zero bytes are none."""
    return "".join(f"<{octet:02X}>" for octet in bytes.fromhex(register).lstrip(b"\0"))


def vb_1com(fields: dict[str, str], **more: Any) -> Framing:
    """The framing of buffer memory #0 and #4 to #11 of a vector (B-4, nine formats)."""
    bfm0 = int(fields["bfm0"], 16)
    ending, total = bfm0 >> 10 & 3, bool(bfm0 >> 13 & 1)
    if int(fields["terminator"], 16):
        number = {0b00: 2, 0b01: 3, 0b11: 4}[ending] + (3 if total else 0)
    else:
        number = {0b00: 1, 0b01: 8, 0b11: 9}[ending]
    return Framing(
        preset="vb-1com",
        format=number,
        header=written(fields["header"]),
        terminator=written(fields["terminator"]),
        conversion=bool(bfm0 >> 12 & 1),
        buffer=8 if bfm0 >> 14 & 1 else 16,
        **more,
    )


def to_words(data: bytes, buffer: int = 16, *, high_first: bool = False) -> list[int]:
    """The buffer words of `data`: low byte first, or one byte per word (`buffer` 8)."""
    if buffer == 8:
        return list(data)
    even = data + bytes(len(data) % 2)
    order: Literal["big", "little"] = "big" if high_first else "little"
    return [int.from_bytes(even[i : i + 2], order) for i in range(0, len(even), 2)]


def from_words(
    words: list[int], count: int, buffer: int = 16, *, high_first: bool = False
) -> bytes:
    """The first `count` bytes of buffer words."""
    if buffer == 8:
        return bytes(word & 0xFF for word in words)[:count]
    order: Literal["big", "little"] = "big" if high_first else "little"
    return b"".join(word.to_bytes(2, order) for word in words)[:count]


def ended_by_terminator(vector: Vector) -> bool:
    return bool(written_out(vb_1com(vector.fields)).mark)


def payload(vector: Vector) -> bytes:
    words = [int(word, 16) for word in vector.fields["buffer_words"]]
    return from_words(words, vector.fields["byte_count"], vb_1com(vector.fields).buffer)


@pytest.mark.parametrize("vector", VALID, ids=repr)
def test_the_vb_1com_frame_is_made_from_its_buffer_words(vector: Vector) -> None:
    assert FrameCodec(vb_1com(vector.fields)).encode(payload(vector)) == vector.frame


@pytest.mark.parametrize("vector", VALID, ids=repr)
@pytest.mark.parametrize("size", [1, 2, 1000])
def test_the_vb_1com_frame_fills_the_buffer_words(vector: Vector, size: int) -> None:
    framing = vb_1com(vector.fields)
    reader = FrameReader(framing)
    found = [
        frame
        for start in range(0, len(vector.frame), size)
        for frame in reader.feed(vector.frame[start : start + size])
    ]
    if not ended_by_terminator(vector):
        assert found == []
        found = reader.expire()
    assert found == [payload(vector)]
    count = vector.fields["byte_count"]
    words = to_words(payload(vector), framing.buffer)
    expected = [int(word, 16) for word in vector.fields["buffer_words"]]
    if framing.buffer == 16 and count % 2:
        expected[-1] &= 0xFF  # an odd count drops the last high byte
    assert words == expected


@pytest.mark.parametrize("vector", VALID, ids=repr)
def test_the_vb_1com_frame_is_complete_by_its_count_before_any_gap(vector: Vector) -> None:
    framing = vb_1com(vector.fields, length=vector.fields["byte_count"])
    assert FrameCodec(framing).feed(vector.frame) == [payload(vector)]


@pytest.mark.parametrize("vector", DAMAGED, ids=repr)
def test_damage_is_reported_with_the_error_number_of_bfm_29(vector: Vector) -> None:
    number = vector.fields["expect"].removeprefix("error code ")
    with pytest.raises(Garbled, match=rf"error {number}\b"):
        FrameCodec(vb_1com(vector.fields)).feed(vector.frame)


@pytest.mark.parametrize("vector", [v for v in VALID if ended_by_terminator(v)], ids=repr)
def test_a_frame_cut_short_is_no_frame(vector: Vector) -> None:
    for end in range(len(vector.frame)):
        reader = FrameReader(vb_1com(vector.fields))
        assert reader.feed(vector.frame[:end]) == []
        assert all(isinstance(item, Garbled) for item in reader.expire())


NINE = [
    # format, header, terminator, what follows the terminator
    (1, "<02>", "", ""),
    (2, "<02>", "<03>", ""),
    (3, "<02>", "<03>", "CR"),
    (4, "<02>", "<03>", "CR LF"),
    (5, "<02>", "<03>", ""),
    (6, "<02>", "<03>", "CR"),
    (7, "<02>", "<03>", "CR LF"),
    (8, "<02>", "", "CR"),
    (9, "<02>", "", "CR LF"),
]


@pytest.mark.parametrize("conversion", [False, True])
@pytest.mark.parametrize(("number", "header", "terminator", "ending"), NINE)
def test_the_nine_formats_with_and_without_conversion_both_ways(
    number: int, header: str, terminator: str, ending: str, conversion: bool
) -> None:
    framing = Framing(
        preset="vb-1com", format=number, header=header, terminator=terminator, conversion=conversion
    )
    plain = written_out(framing)
    assert (plain.sum_check, plain.ending) == (5 <= number <= 7, ending)
    data = payload(VALID[0])  # ABCDE
    sent = framing_of(plain, data)
    assert FrameCodec(framing).encode(data) == sent
    reader = FrameReader(framing)
    assert (reader.feed(sent) or reader.expire()) == [data]


def framing_of(plain: Framing, data: bytes) -> bytes:
    """The frame as the manual's drawing of the formats has it, put together by hand."""
    line = b"".join(b"%02X" % octet for octet in data) if plain.conversion else data
    end = b"\x03" if plain.terminator else b""
    total = b"%02X" % (sum(line + end) % 256) if plain.sum_check else b""
    return b"\x02" + line + end + total + {"": b"", "CR": b"\r", "CR LF": b"\r\n"}[plain.ending]


def test_without_helper_functions_the_whole_frame_is_data() -> None:
    raw = next(v for v in VALID if v.id == "noproto-vb1com-023")
    helped = next(v for v in VALID if v.id == "noproto-vb1com-018")
    assert payload(raw) == raw.frame == helped.frame


@pytest.mark.parametrize("rule", ["first_byte_only", "whole_header"])
def test_the_sum_of_a_longer_header_leaves_out_its_first_byte_or_all_of_it(rule: str) -> None:
    short = next(v for v in VALID if v.id == "noproto-vb1com-008").frame
    header = next(v for v in VALID if v.id == "noproto-vb1com-028").frame[:4]
    framing = Framing(
        preset="vb-1com",
        format=5,
        header="<01><02><03><04>",
        terminator="<03>",
        sum_header_rule=rule,  # type: ignore[arg-type]  # a str from parametrize
    )
    more = sum(header[1:]) if rule == "first_byte_only" else 0
    total = b"%02X" % (int(short[-2:], 16) + more)
    sent = FrameCodec(framing).encode(b"ABCDE")
    assert sent == header + short[1:-2] + total
    assert FrameCodec(framing).feed(sent) == [b"ABCDE"]


@pytest.mark.parametrize("vector", RS, ids=repr)
def test_the_rs_instruction_sends_and_receives_its_words(vector: Vector) -> None:
    fields = vector.fields
    buffer: Literal[16, 8] = 8 if fields["m9161"] else 16
    data = from_words([int(word, 16) for word in fields["words"]], fields["count"], buffer)
    framing = Framing(
        preset="vigor-rs",
        header=code(fields["start_code"]),
        terminator=code(fields["end_code"]),
        buffer=buffer,
    )
    assert FrameCodec(framing).encode(data) == vector.frame
    reader = FrameReader(framing)
    assert (reader.feed(vector.frame) or reader.expire()) == [data]
    assert to_words(data, buffer) == [int(word, 16) for word in fields["words"]]
    assert reader.gap_timeout == 0.1  # D9129 = 0


def code(value: int | None) -> str:
    return "" if value is None else f"<{value:02X}>"


@pytest.mark.parametrize("vector", EX485LNK, ids=repr)
def test_the_ex485lnk_user_mode_sends_and_receives_its_words(vector: Vector) -> None:
    fields = vector.fields
    buffer: Literal[16, 8] = 8 if int(fields["bfm0"], 16) >> 14 & 1 else 16
    data = from_words([int(word, 16) for word in fields["words"]], fields["byte_count"], buffer)
    framing = Framing(
        preset="ex485lnk-user",
        header=written(fields["header"]),
        terminator=written(fields["terminator"]),
        buffer=buffer,
    )
    assert FrameCodec(framing).encode(data) == vector.frame
    assert FrameCodec(framing).feed(vector.frame) == [data]


@pytest.mark.parametrize("vector", K120S, ids=repr)
def test_k120s_saves_the_whole_frame_its_end_byte_included(vector: Vector) -> None:
    fields = vector.fields
    if "cw" in fields:
        high, low = divmod(int(fields["cw"], 16), 256)
        ends = {"terminator": f"<{low:02X}>"} if high == 1 else {"length": low}
        framing = Framing(preset="k120s-drcv", **ends)
        assert FrameCodec(framing).feed(vector.frame) == [vector.frame]
        assert len(vector.frame) == fields.get("length", len(vector.frame))
    else:
        assert FrameCodec(Framing(preset="k120s-dsnd")).encode(vector.frame) == vector.frame
        assert len(vector.frame) == fields["n"]
    for name in ("words_low_first", "words_high_first"):
        if name in fields:
            words = [int(word, 16) for word in fields[name]]
            high_first = name == "words_high_first"
            assert to_words(vector.frame, high_first=high_first) == words
            assert from_words(words, len(vector.frame), high_first=high_first) == vector.frame


def test_k120s_counts_the_end_byte_into_its_255() -> None:
    codec = FrameCodec(Framing(preset="k120s-drcv", terminator="<03>"))
    assert codec.feed(b"A" * 254 + b"\x03") == [b"A" * 254 + b"\x03"]
    with pytest.raises(Garbled, match="error 10"):
        codec.feed(b"A" * 255 + b"\x03")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"preset": "vb-1com", "format": 2, "terminator": "<20>"}, "error 9"),
        ({"preset": "vb-1com", "format": 2, "terminator": "A<7F>"}, "error 9"),
        ({"preset": "ex485lnk-user", "terminator": "A"}, "error 9"),
        ({"preset": "vb-1com"}, "format 1..9"),
        ({"preset": "vb-1com", "format": 10}, "format 1..9"),
        ({"preset": "vb-1com", "format": 2}, "needs a terminator"),
        ({"preset": "vb-1com", "format": 1, "terminator": "<03>"}, "has no terminator"),
        ({"preset": "vb-1com", "format": 5, "terminator": "<03>"}, "needs a header"),
        ({"preset": "vb-1com", "format": 1, "sum_check": True}, "no setting sum_check"),
        ({"preset": "vigor-rs", "header": "<01><02>"}, "one byte"),
        ({"preset": "vigor-rs", "conversion": True}, "no setting conversion"),
        ({"preset": "vigor-rs", "length": 257}, "holds 256"),
        ({"preset": "ex485lnk-user", "length": 129}, "holds 128"),
        ({"preset": "ex485lnk-user", "buffer": 8, "length": 65}, "holds 64"),
        ({"preset": "ex485lnk-user", "ending": "CR"}, "no setting ending"),
        ({"preset": "k120s-drcv"}, "write one of them"),
        ({"preset": "k120s-drcv", "length": 3, "terminator": "<03>"}, "write one of them"),
        ({"preset": "k120s-drcv", "length": 256}, "holds 255"),
        ({"preset": "k120s-drcv", "terminator": "<0D><0A>"}, "one last byte"),
        ({"preset": "k120s-dsnd", "header": "<02>"}, "no setting header"),
        ({"format": 3}, "belongs to preset vb-1com"),
        ({"header": "<01><02><03><04><05>"}, "longer than 4"),
        ({"sum_check": True}, "needs a terminator"),
        ({"keep_terminator": True}, "needs a terminator"),
        ({"keep_terminator": True, "terminator": "<03>", "ending": "CR"}, "cannot follow"),
        ({"length": 0}, r"not 1\.\.512"),
        ({"buffer": 8, "max_length": 257}, r"not 1\.\.256"),
        ({"length": 3, "max_length": 4}, "write one of them"),
        ({"gap": 0.015}, "steps of 10 ms"),
        ({"gap": 0.0}, "steps of 10 ms"),
        ({"gap": 330.0}, "steps of 10 ms"),
        ({"header": "<STY>"}, "neither two hex digits"),
        ({"header": "\\x02"}, "control characters are written"),
        ({"header": "<02"}, "control characters are written"),
        ({"terminator": "ü"}, "beyond ASCII"),
        ({"terminator": "{end}"}, "nothing can be filled in"),
    ],
)
def test_a_framing_that_cannot_be_is_refused(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        written_out(Framing(**settings))  # type: ignore[arg-type]  # mistakes are the point


def test_one_end_of_a_longer_terminator_in_range_is_enough() -> None:
    # Which end the manual calls its first byte is open.
    for terminator in ("<0D>A", "A<0D>"):
        written_out(Framing(preset="vb-1com", format=2, terminator=terminator))


@pytest.mark.parametrize(
    ("framing", "data"),
    [
        (Framing(terminator="<03>"), b"A\x03B"),
        (Framing(header="<02>", terminator="<03>"), b"A\x02B"),
        (Framing(ending="CR LF"), b"A\rB"),
        (Framing(terminator="<03>", ending="CR"), b"A\rB"),
        (Framing(terminator="**"), b"A*"),
        (Framing(header="**", terminator="<03>"), b"*A"),
        (Framing(), bytes(513)),
        (Framing(buffer=8), bytes(257)),
    ],
)
def test_data_that_would_be_cut_at_the_wrong_place_is_not_sent(
    framing: Framing, data: bytes
) -> None:
    with pytest.raises(BadValue):
        FrameCodec(framing).encode(data)


def test_a_name_for_every_control_character_but_form_feed() -> None:
    named = re.findall(r"<\w+>", "<NUL><SOH><STX><ETX><EOT><ENQ><ACK><BEL><BS><HT><LF><VT><0C><CR>")
    assert [FrameCodec(Framing(header=one)).encode(b"") for one in named] == [
        bytes([code]) for code in range(14)
    ]
    assert FrameCodec(Framing(header="<FF>")).encode(b"") == b"\xff"
