"""Strange requests to served stations: each has one reply, or none, and writes nothing by halves.

Frames are built here from the manuals alone, not by the codecs of the gateway.
"""

import pytest

from tests.serving.bench import Bench

VIGOR = {
    "protocol": "vigor",
    "station": 5,
    "accept": ["D0..D3", "M100..M107"],
    "tags": {
        "d0": {"address": "D0"},
        "long": {"address": "D2", "type": "int32"},
        "speed": {"address": "D10", "source": "mixer/speed"},
        "m": {"address": "M100"},
    },
}
LINK = {
    "protocol": "computer-link",
    "station": 5,
    "accept": ["D0000..D0001", "D0010..D0011", "M0010..M0011", "M8126", "CN200"],
    "tags": {
        "a": {"address": "D0000"},
        "b": {"address": "D0001"},
        "long": {"address": "D0010", "type": "int32"},
        "m1": {"address": "M0010"},
        "m2": {"address": "M0011"},
        "global": {"address": "M8126"},
        "count": {"address": "CN200"},
        "speed": {"address": "D0100", "source": "mixer/speed"},
    },
}


def made(station: dict[str, object]) -> Bench:
    bench = Bench("/dev/ttyS98", {"plc": station})
    bench.values["mixer/speed"] = 50
    return bench


def vigor(text: str) -> bytes:
    body = text.encode("latin-1") + b"\x03"
    return b"\x02" + body + b"%02X" % (sum(body) & 255)


@pytest.mark.parametrize(
    ("request_", "status"),
    [
        (vigor("05511C1400"), "5128"),  # no byte
        (vigor("05511C14FF"), "5128"),  # more than a reply carries
        (vigor("05515BFE04"), "5128"),  # over the end of D
        (vigor("05511C1404"), "5128"),  # a word without a tag follows
        (vigor("05611C000211"), "6110"),  # less data than it says
        (vigor("05611C0002112233"), "6110"),  # more data
        (vigor("05611C000A" + "00" * 10), "6128"),  # the last word is not accepted
        (vigor("05611C0402FFFF"), "6128"),  # one half of a long value
        (vigor("05611C000112"), "6128"),  # one byte of a word
        (vigor("05701C00"), "7028"),  # forces a register
        (vigor("05991C0002"), "9912"),
        (vigor("0551ZZZZ02"), "5110"),
        (vigor("05511C1402")[:-1] + b"G", "5110"),
        (vigor("05511C1402")[:-2] + b"00", "5111"),
        (vigor("07511C1402"), ""),
        (vigor("00611C00020000"), ""),
        (b"\x0607510000\x034B", ""),  # the reply of another station
        (b"\x02\x03", ""),
        (b"\x02" + b"0" * 700, ""),
    ],
)
def test_a_strange_vigor_request_gets_its_status_and_writes_nothing(
    request_: bytes, status: str
) -> None:
    bench = made(VIGOR)
    assert bench.ask(request_)[3:-3].decode("latin-1") == status
    assert bench.written == []
    assert b"00" in bench.ask(vigor("05511C1402"))  # the next one is served


def link(text: str, frame_format: int) -> bytes:
    body = text.encode("latin-1")
    return b"\x05" + body + b"%02X" % (sum(body) & 255) + b"\r\n" * (frame_format == 4)


@pytest.mark.parametrize("frame_format", [1, 4])
@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("05FFZZ0D010001", "03"),
        ("05FEWR0D010001", "10"),
        ("05FFWRGD010001", "06"),  # no message wait
        ("05FFWR0D010000", "06"),
        ("05FFWR0D010041", "06"),  # 65 words
        ("05FFWR0M152802", "06"),  # over the end of M
        ("05FFBR0X000801", "06"),  # X is octal
        ("05FFWW0D000003000100010001", "06"),  # over what is accepted
        ("05FFWW0D0010010001", "06"),  # one half of a long value
        ("05FFWW0M0010010003", "06"),  # 16 points, of which two are accepted
        ("05FFBW0M0010022X", "07"),
        ("05FFWW0D000001000G", "07"),
        ("05FFBT015" + "M00101" * 21, "06"),
        ("05FFWT00B" + "D00000001" * 11, "06"),
        ("05FFBT002M00101M00991", "06"),  # the second one is not accepted
        ("05FFMB0", "06"),  # no list yet
        ("05FFBM000", "06"),
        ("05FFBM00B" + "M0010" * 11, "06"),
        ("05FFBM001M0099", "06"),
        ("05FFBM001D0000", "06"),  # a word in a list of bits
        ("05FFWM001CN200", "06"),  # 32 bits
        ("05FFRR0", "18"),
        ("05FFTT000", "06"),
        ("0fFFWR0D010001", ""),
        ("FFFFBR0M001001", ""),  # to all: only GW is carried out
        ("FFFFWW0D0000010007", ""),
        ("05FFGW02", ""),
    ],
)
def test_a_strange_link_request_gets_its_code_and_writes_nothing(
    text: str, code: str, frame_format: int
) -> None:
    bench = made({**LINK, "frame_format": frame_format})
    expected = b"\x1505FF" + code.encode() + b"\r\n" * (frame_format == 4) if code else b""
    assert bench.ask(link(text, frame_format)) == expected
    assert bench.written == []
    assert b"0032" in bench.ask(link("05FFWR0D010001", frame_format))


@pytest.mark.parametrize("frame_format", [1, 4])
def test_a_refused_list_leaves_the_old_one(frame_format: int) -> None:
    bench = made({**LINK, "frame_format": frame_format})
    assert bench.ask(link("05FFBW0M00100211", frame_format)).startswith(b"\x06")
    assert bench.ask(link("05FFBM002M0010M0011", frame_format)).startswith(b"\x06")
    for text in ("05FFBM000", "05FFBM001M0099", "05FFWM001CN200", "05FFWM001D0100"):
        bench.ask(link(text, frame_format))
        assert b"05FF11\x03" in bench.ask(link("05FFMB0", frame_format))


@pytest.mark.parametrize("frame_format", [1, 4])
def test_of_one_bit_twice_in_a_request_the_last_one_counts(frame_format: int) -> None:
    bench = made({**LINK, "frame_format": frame_format})
    assert bench.ask(link("05FFBT002M00101M00100", frame_format)).startswith(b"\x06")
    assert bench.written == [{"m1": False}]


@pytest.mark.parametrize("cancel", [b"\x04", b"\x0c", b"\x06", b"\x15"])
def test_eot_cl_ack_and_nak_cancel_half_a_request(cancel: bytes) -> None:
    bench = made({**LINK, "frame_format": 4})
    request = link("05FFWW0D0000010001", 4)
    assert bench.ask(request[:9] + cancel + request[9:]) == b""
    assert bench.written == []
    assert b"0032" in bench.ask(link("05FFWR0D010001", 4))
