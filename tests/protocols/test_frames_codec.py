"""FrameReader, FrameCodec: whatever arrives gives frames, damage or silence, in bounded memory."""

import random
import tracemalloc
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gateway.errors import BadValue, ConfigError, Evidence, Garbled
from gateway.protocols.frames import FrameCodec, FrameReader, Framing
from gateway.protocols.frames.framing import Check, End
from gateway.protocols.frames.presets import written_out

SMALL = 8  # a short maximum, so that few bytes reach every branch
CHARACTERS = b"\x02\x03\r\nA0F*"  # marks are as likely as data

marks = st.sampled_from(["<02>", "<03>", "<02><03>", "**", "<10><02>", "A"])
nothing = st.just("")


def longest(framing: Framing) -> int:
    """The characters of the longest frame on the line."""
    known = written_out(framing)
    return known.on_line(known.longest)


@st.composite
def framings(draw: st.DrawFn) -> Framing:
    exact = draw(st.booleans())
    terminator = draw(marks | nothing)
    keep = bool(terminator) and draw(st.integers(0, 4)) == 0
    ending = "" if keep else draw(st.sampled_from(["", "CR", "CR LF"]))
    total = bool(terminator) and not keep and draw(st.booleans())
    conversion = draw(st.booleans())
    checks: list[Check | None] = [None]
    if not total and not keep:
        checks.append("lrc")
        if exact or conversion or not (terminator or ending):
            checks.append("crc16")
    ends: list[End] = ["terminator"] if terminator or ending else []
    if not total:
        if not ends or (terminator, ending) in (("<03>", ""), ("A", ""), ("", "CR")):
            ends.append("count")
        ends.append("gap")
    return Framing(
        header=draw(marks | nothing),
        terminator=terminator,
        ending=ending,  # type: ignore[arg-type]  # a str from the strategy
        sum_check=total,
        conversion=conversion,
        keep_terminator=keep,
        length=draw(st.integers(1, SMALL)) if exact else None,
        max_length=None if exact else SMALL,
        check=draw(st.sampled_from(checks)),
        ends=tuple(ends) if not exact and draw(st.booleans()) else (),
    )


noise = st.one_of(
    st.binary(max_size=60),
    # Even for hypothesis, which likes short lists: enough marks in a row to make frames of.
    st.integers(0, 2**32).map(lambda seed: bytes(random.Random(seed).choices(CHARACTERS, k=60))),
    st.lists(st.sampled_from(list(CHARACTERS)), max_size=60).map(bytes),
)
sizes = st.lists(st.integers(1, 9), min_size=1, max_size=8)


def pieces(data: bytes, cuts: list[int]) -> list[bytes]:
    found: list[bytes] = []
    at = 0
    while at < len(data):
        size = cuts[len(found) % len(cuts)]
        found.append(data[at : at + size])
        at += size
    return found


def frames(items: list[bytes | Garbled]) -> list[bytes]:
    return [item for item in items if not isinstance(item, Garbled)]


@settings(max_examples=200)
@given(framings(), st.binary(max_size=SMALL), noise, sizes)
def test_an_encoded_frame_is_decoded_in_any_pieces(
    framing: Framing, data: bytes, after: bytes, cuts: list[int]
) -> None:
    data = data[: framing.length]
    data = data.ljust(framing.length or 0, b"A")
    try:
        sent = FrameCodec(framing).encode(data)
    except BadValue:
        return
    if framing.keep_terminator:
        return  # DRCV: what is sent is the user's own, K120S tests have it
    reader = FrameReader(framing)
    found = [item for piece in pieces(sent, cuts) for item in reader.feed(piece)]
    if not framing.mark and framing.length is None and len(data) < SMALL:
        found += reader.expire()
        assert found == [data] or not sent
    else:
        assert found == [data]


ONE_BYTE_TOO_LONG = Framing(
    header="<02>", terminator="<02><03>", max_length=8, ends=("terminator", "gap")
)


@settings(max_examples=300)
@given(framings(), noise, sizes, st.booleans())
@example(ONE_BYTE_TOO_LONG, b"\x02" + bytes(9), [1], False)
def test_any_bytes_in_any_pieces_give_the_same_frames_and_never_fail(
    framing: Framing, data: bytes, cuts: list[int], quiet: bool
) -> None:
    whole, chopped = FrameReader(framing, quiet=quiet), FrameReader(framing, quiet=quiet)
    at_once = whole.feed(data) + whole.expire()
    by_pieces: list[bytes | Garbled] = []
    for piece in pieces(data, cuts):
        by_pieces += chopped.feed(piece)
        assert chopped.pending <= longest(framing)
    by_pieces += chopped.expire()
    assert frames(at_once) == frames(by_pieces)
    assert chopped.pending == 0
    most = framing.longest + (len(framing.mark) if framing.keep_terminator else 0)
    assert all(len(frame) <= most for frame in frames(at_once))


@settings(max_examples=200)
@given(framings(), noise, sizes)
def test_one_transaction_gives_frames_garbled_or_silence(
    framing: Framing, data: bytes, cuts: list[int]
) -> None:
    codec = FrameCodec(framing)
    if hear(codec, pieces(data, cuts)) is not None:
        with pytest.raises(Garbled):  # a codec that was damaged stays so
            codec.feed(b"")


def hear(codec: FrameCodec, heard: list[bytes]) -> Garbled | None:
    """Feeds all of it; the damage, if there was any. Nothing else may be raised."""
    try:
        for piece in heard:
            codec.feed(piece)
        codec.expire()
    except Garbled as error:
        return error
    return None


@settings(max_examples=400)
@given(noise, sizes, st.sampled_from(["", "CR", "CR LF"]), st.booleans(), st.booleans())
def test_a_valid_frame_after_noise_is_found(
    before: bytes, cuts: list[int], ending: str, total: bool, conversion: bool
) -> None:
    framing = Framing(
        header="<02>",
        terminator="<03>",
        ending=ending,  # type: ignore[arg-type]  # a str from the strategy
        sum_check=total,
        conversion=conversion,
        max_length=SMALL,
    )
    stream = before + FrameCodec(framing).encode(b"0A0F")
    reader = FrameReader(framing)
    found = frames([item for piece in pieces(stream, cuts) for item in reader.feed(piece)])
    assert found[-1:] == [b"0A0F"]


@settings(max_examples=100)
@given(noise)
def test_a_gap_ends_all_noise(before: bytes) -> None:
    for framing in (
        Framing(length=4, conversion=True),
        Framing(header="<02>", length=4),
        Framing(terminator="<03>", sum_check=True),
        Framing(ending="CR LF"),
        Framing(),
    ):
        reader = FrameReader(framing, quiet=False)
        reader.feed(before)
        reader.expire()
        heard = reader.feed(FrameCodec(framing).encode(b"0A0F"))
        assert (heard or reader.expire()) == [b"0A0F"]


def test_a_frame_that_began_before_the_port_opened_is_not_a_whole_one() -> None:
    framing = Framing(ending="CR LF")
    late = FrameReader(framing, quiet=False)
    assert late.feed(b"2.50\r\n12.50\r\n") == [b"12.50"]
    in_time = FrameReader(framing, quiet=False)
    in_time.settle()
    assert in_time.feed(b"12.50\r\n") == [b"12.50"]


def test_a_begun_frame_before_a_whole_one_is_noise() -> None:
    reader = FrameReader(Framing(header="<02>", terminator="<03>"))
    assert reader.feed(b"\x0212.\x0212.50\x03") == [b"12.50"]


def test_of_an_exact_length_the_data_may_be_any_bytes() -> None:
    framing = Framing(header="<02>", terminator="<03>", length=4)
    data = b"\x03\x02\x02\x03"
    assert FrameCodec(framing).feed(FrameCodec(framing).encode(data)) == [data]


def test_an_exact_length_with_its_terminator_elsewhere_is_error_10() -> None:
    with pytest.raises(Garbled, match="error 10"):
        FrameCodec(Framing(header="<02>", terminator="<03>", length=4)).feed(b"\x02ABC\x03D")


def test_the_count_ends_a_frame_that_nothing_else_ends() -> None:
    assert FrameCodec(Framing(max_length=4)).feed(b"ABCDEFGH") == [b"ABCD", b"EFGH"]


def test_no_terminator_within_the_longest_frame_is_error_10() -> None:
    codec = FrameCodec(Framing(header="<02>", terminator="<03>", max_length=4))
    with pytest.raises(Garbled, match="error 10, terminator missing after 4 bytes") as caught:
        codec.feed(b"\x02ABCDE")
    assert caught.value.data == b"\x02ABCDE"


@pytest.mark.parametrize(
    ("heard", "message"),
    [
        (b"\x02AB", "error 10, terminator missing"),
        (b"\x02AB\x03", "error 4, sum missing"),
        (b"\x02AB\x038", "error 4, sum missing"),
        (b"\x02AB\x0386", "error 7, CR missing"),
        (b"\x02AB\x0386\r", "error 8, LF missing"),
    ],
)
def test_a_gap_inside_a_frame_names_the_missing_part(heard: bytes, message: str) -> None:
    codec = FrameCodec(
        Framing(header="<02>", terminator="<03>", sum_check=True, ending="CR LF", gap=0.05)
    )
    assert codec.feed(heard) == []
    with pytest.raises(Garbled, match=message) as caught:
        codec.expire()
    assert caught.value.evidence is Evidence.TRUNCATED


def test_a_good_frame_is_handed_out_before_the_damage_behind_it() -> None:
    codec = FrameCodec(Framing(header="<02>", terminator="<03>", max_length=4))
    assert codec.feed(b"\x02AB\x03\x02ABCDE\x02AB\x03\x02CDEFGH") == [b"AB"]
    for heard in (b"", b"\x02CDEFGH"):
        with pytest.raises(Garbled, match="error 10") as caught:
            codec.feed(heard)
        assert caught.value.data.startswith(b"\x02ABCDE")  # the first damage is told, and kept


NOISY = {
    "header never ends": (Framing(header="<02>", terminator="<03>"), b"\x02A"),
    "headers only": (Framing(header="<02>", terminator="<03>"), b"\x02"),
    "no terminator": (Framing(ending="CR LF"), b"AB"),
    "terminators only": (Framing(header="<02>", terminator="<03>", sum_check=True), b"\x03"),
    "length and header": (Framing(header="<02>", terminator="<03>", length=512), b"\x02AAAAA"),
    "random": (Framing(header="<02>", terminator="<03>", sum_check=True), None),
}


@pytest.mark.parametrize("name", NOISY)
def test_endless_noise_leaves_memory_flat(name: str) -> None:
    """A slice of what benchmarks/frames_noise.py does with 100 MB."""
    framing, unit = NOISY[name]
    chunk = 64 * 1024
    seeded = random.Random(1)
    piece = seeded.randbytes(chunk) if unit is None else (unit * chunk)[:chunk]
    reader = FrameReader(framing)
    reader.feed(piece)
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        for _ in range(8):
            reader.feed(piece)
        after, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert reader.pending <= longest(framing)
    assert after - before < 8_000
    assert peak - before < 2_000_000


def test_damage_without_a_header_voids_everything_up_to_the_next_end_of_a_frame() -> None:
    reader = FrameReader(Framing(ending="CR LF", max_length=4))
    found = reader.feed(b"ABCDEFG\r\nHI\r\n")
    assert frames(found) == [b"HI"]
    assert isinstance(found[0], Garbled)


def test_a_wrong_sum_takes_only_its_own_frame() -> None:
    for header in ("", "<02>"):
        framing = Framing(header=header, terminator="<03>", sum_check=True)
        good = FrameCodec(framing).encode(b"AB")
        damaged = good[:-1] + bytes([good[-1] ^ 1])
        found = FrameReader(framing).feed(damaged + good)
        assert [type(item) for item in found] == [Garbled, bytes]
        assert found[1] == b"AB"


def test_a_false_frame_whose_sum_would_be_the_next_header_does_not_take_it() -> None:
    framing = Framing(header="<02>", terminator="<03>", sum_check=True)
    good = FrameCodec(framing).encode(b"AB")
    assert frames(FrameReader(framing).feed(b"\x02\x03" + good)) == [b"AB"]


def test_hex_digits_may_be_small_letters_for_they_mean_nothing_else() -> None:
    framing = Framing(header="<02>", terminator="<03>", sum_check=True, conversion=True)
    sent = FrameCodec(framing).encode(b"\xab\xcd\xef")
    assert sent[1:-3] == b"ABCDEF"
    line = sent[1:-2].lower()
    assert FrameCodec(framing).feed(b"\x02" + line + b"%02x" % (sum(line) % 256)) == [
        b"\xab\xcd\xef"
    ]
    other = Framing(header="<02>", terminator="<03>", sum_check=True)
    sum_of_letters = FrameCodec(other).encode(b"xyz")
    assert sum_of_letters != sum_of_letters.lower()
    assert FrameCodec(other).feed(sum_of_letters.lower()) == [b"xyz"]


def test_half_a_converted_byte_is_error_3() -> None:
    with pytest.raises(Garbled, match="error 3"):
        FrameCodec(Framing(terminator="<03>", conversion=True)).feed(b"ABC\x03")


RS = Framing(terminator="<03>", max_length=4, ends=("terminator", "count", "gap"))


def test_count_end_code_or_time_out_whichever_is_first() -> None:
    """Vigor RS instruction, B-3-9: each of the three completes a reception."""
    reader = FrameReader(RS)
    assert reader.feed(b"AB\x03CDEFGH") == [b"AB", b"CDEF"]
    assert reader.expire() == [b"GH"]


def test_an_end_code_directly_after_the_last_counted_byte_belongs_to_that_frame() -> None:
    reader = FrameReader(RS)
    assert reader.feed(b"ABCD") == [b"ABCD"]
    assert reader.feed(b"\x03EF\x03") == [b"EF"]


def test_an_end_code_after_a_counted_frame_and_a_gap_is_an_empty_frame() -> None:
    reader = FrameReader(RS)
    assert [*reader.feed(b"ABCD"), *reader.expire(), *reader.feed(b"\x03")] == [b"ABCD", b""]


def test_an_end_that_is_not_named_does_not_complete_a_frame() -> None:
    only = FrameReader(Framing(max_length=4, ends=("count",)))
    assert only.feed(b"AB") == []
    assert isinstance(only.expire()[0], Garbled)
    by_gap = FrameReader(Framing(max_length=4, ends=("gap",)))
    found = by_gap.feed(b"ABCDEFGH")
    assert frames(found) == []
    assert isinstance(found[0], Garbled)


@pytest.mark.parametrize(
    ("settings_", "message"),
    [
        ({"length": 4, "ends": ("gap",)}, "length is exact"),
        ({"terminator": "<03>", "ends": ("gap",)}, "must name the terminator"),
        ({"ends": ("terminator",)}, "needs a terminator or ending"),
        ({"ends": ("count",)}, "max_length, which is missing"),
        ({"ends": ("gap", "gap")}, "twice"),
        ({"terminator": "<03>", "sum_check": True, "ends": ("terminator", "gap")}, "sum_check"),
        ({"ending": "CR LF", "max_length": 4, "ends": ("terminator", "count")}, "one byte"),
        ({"ending": "CR", "check": "crc16"}, "two bytes of any value"),
        ({"terminator": "<03>", "sum_check": True, "check": "lrc"}, "one check"),
    ],
)
def test_ends_and_checks_that_cannot_work_say_why(settings_: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Framing(**settings_)


ASCII = Framing(header=":", ending="CR LF", conversion=True, check="lrc")
RTU = Framing(length=6, check="crc16")


def test_an_lrc_and_a_crc_as_modbus_writes_them() -> None:
    """The frames of the Modbus specification: address 11h, read 3 registers from 6Bh."""
    request = bytes.fromhex("1103006B0003")
    assert FrameCodec(ASCII).encode(request) == b":1103006B00037E\r\n"
    assert FrameCodec(RTU).encode(request) == request + bytes.fromhex("7687")
    for framing in (ASCII, RTU):
        assert FrameCodec(framing).feed(FrameCodec(framing).encode(request)) == [request]


@pytest.mark.parametrize("framing", [ASCII, RTU, Framing(terminator="<03>", check="lrc")])
def test_each_flipped_bit_of_data_or_check_is_found(framing: Framing) -> None:
    good = FrameCodec(framing).encode(b"ABCDEF")
    for bit in range(8 * len(good)):
        damaged = bytearray(good)
        damaged[bit // 8] ^= 1 << bit % 8
        reader = FrameReader(framing)
        found = frames(reader.feed(bytes(damaged)) + reader.expire())
        assert found in ([], [b"ABCDEF"])  # small letters of a hexadecimal digit mean the same


def test_a_wrong_check_is_told_as_a_checksum() -> None:
    (damage,) = FrameReader(RTU).feed(bytes(8))
    assert isinstance(damage, Garbled)
    assert damage.evidence is Evidence.CHECKSUM
    assert (str(damage), damage.data) == ("wrong crc16", bytes(8))
