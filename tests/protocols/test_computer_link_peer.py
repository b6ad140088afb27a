"""The Computer Link driver against a PLC written byte by byte from the manual."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.errors import Refused
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.computer_link.devices import ProfileName
from gateway.protocols.driver import Cost, Span, Unit
from tests.doubles import Wire, in_pieces
from tests.protocols.computer_link_peer import PROCEDURES, Peer, Procedure

LETTERS = {"M8": "M", "D8": "D", "T": "TN", "C": "CN", "C32": "CN"}

drivers = st.builds(
    lambda procedure, profile, area_c, word: ComputerLink(
        station=5,
        frame_format=procedure[0],
        sum_check=procedure[1],
        profile=profile,
        send_area_c=area_c,
        monitor=profile != "fx",
        monitor_word_command=word,
    ),
    st.sampled_from(PROCEDURES),
    st.sampled_from(["liyan", "fx"]),
    st.booleans(),
    st.sampled_from(["MN", "MW"]),
)


def peer_of(driver: ComputerLink) -> Peer:
    return Peer(5, driver.frame_format, driver.sum_check, fx=driver.profile == "fx")


def names(peer: Peer, span: Span) -> list[str]:
    letters = LETTERS.get(span.area, span.area)
    return [peer.name(letters, number) for number in range(span.start, span.start + span.size)]


@st.composite
def spans(draw: st.DrawFn, driver: ComputerLink, longest: int = 300) -> Span:
    area = driver.areas[draw(st.sampled_from(sorted(driver.areas)))]
    start = draw(st.integers(area.first, area.last))
    size = draw(st.integers(1, min(longest, area.last + 1 - start)))
    if draw(st.booleans()):  # word boundaries, where the ways part
        start -= start % 8
        size = max(1, size - size % 16)
    return Span(area.name, start, size)


@st.composite
def neighbours(draw: st.DrawFn, driver: ComputerLink) -> list[Span]:
    """A few short spans, of points or of words, or of both."""
    areas = draw(st.sampled_from([["M", "Y", "TS", "M8"], ["D", "T", "C", "D8"], ["M", "S", "D"]]))
    found = []
    for area in draw(st.lists(st.sampled_from(areas), min_size=1, max_size=5)):
        first = driver.areas[area].first
        start = first + draw(st.integers(0, 60))
        if draw(st.booleans()) and driver.areas[area].unit is Unit.BIT:
            found.append(Span(area, start - start % 8, 16))
        else:
            found.append(Span(area, start, draw(st.integers(1, 4))))
    return found


def values(data: st.DataObject, driver: ComputerLink, span: Span) -> list[int]:
    top = {Unit.BIT: 1, Unit.WORD: 0xFFFF, Unit.DWORD: 0xFFFFFFFF}[driver.areas[span.area].unit]
    return data.draw(st.lists(st.integers(0, top), min_size=span.size, max_size=span.size))


@settings(max_examples=120)
@given(st.data(), drivers, st.integers(1, 7))
async def test_a_read_returns_the_devices_at_exactly_its_cost(
    data: st.DataObject, driver: ComputerLink, pieces: int
) -> None:
    span = data.draw(spans(driver))
    peer = peer_of(driver)
    units = values(data, driver, span)
    peer.devices = dict(zip(names(peer, span), units, strict=True))
    wire = Wire(driver, lambda data: in_pieces(peer.hear(data), pieces))
    cost = driver.cost(span)
    if cost is None:
        with pytest.raises(ValueError, match="does not fit"):
            await driver.read(wire, span)
        return
    assert list(await driver.read(wire, span)) == units
    assert wire.cost == cost
    assert peer.confirmed == driver.send_area_c


@settings(max_examples=120)
@given(st.data(), drivers)
async def test_a_write_changes_only_its_devices_at_exactly_its_cost(
    data: st.DataObject, driver: ComputerLink
) -> None:
    span = data.draw(spans(driver, 170))
    peer = peer_of(driver)
    units = values(data, driver, span)
    wire = Wire(driver, lambda data: [peer.hear(data)])
    cost = driver.write_cost(span)
    if cost is None:
        with pytest.raises(ValueError, match="does not fit"):
            await driver.write(wire, span, units)
        return
    assert await driver.write(wire, span, units) is True
    assert peer.devices == dict(zip(names(peer, span), units, strict=True))
    assert wire.cost == cost


@settings(max_examples=120)
@given(st.data(), drivers)
async def test_a_scattered_write_changes_its_devices_and_no_other(
    data: st.DataObject, driver: ComputerLink
) -> None:
    parts = [(span, values(data, driver, span)) for span in data.draw(neighbours(driver))]
    peer = peer_of(driver)
    wire = Wire(driver, lambda data: [peer.hear(data)])
    cost = driver.scattered_write_cost([span for span, _ in parts])
    if cost is None:
        return
    assert await driver.write_scattered(wire, parts) is True
    expected: dict[str, int] = {}
    for span, units in parts:
        fresh = dict(zip(names(peer, span), units, strict=True))
        assert not fresh.keys() & expected.keys()
        expected |= fresh
    assert peer.devices == expected
    assert wire.cost == cost


@settings(max_examples=120)
@given(st.data(), drivers)
async def test_registered_devices_are_read_in_their_order(
    data: st.DataObject, driver: ComputerLink
) -> None:
    asked = data.draw(neighbours(driver))
    peer = peer_of(driver)
    for span in asked:
        units = values(data, driver, span)
        peer.devices |= dict(zip(names(peer, span), units, strict=True))
    cost = driver.monitor_cost(asked)
    if cost is None:
        return
    wire = Wire(driver, lambda data: [peer.hear(data)])
    with pytest.raises(Refused):  # nothing is registered yet
        await driver.read_registered(wire, asked)
    await driver.register(wire, asked)
    wire = Wire(driver, lambda data: [peer.hear(data)])
    read = await driver.read_registered(wire, asked)
    assert [list(units) for units in read] == [
        [peer.devices[name] for name in names(peer, span)] for span in asked
    ]
    assert wire.cost == cost


@settings(max_examples=200)
@given(st.data(), drivers)
def test_if_a_span_is_too_long_no_longer_one_is_not(
    data: st.DataObject, driver: ComputerLink
) -> None:
    span = data.draw(spans(driver, 600))
    first = data.draw(st.integers(0, span.size - 1))
    inner = Span(span.area, span.start + first, data.draw(st.integers(1, span.size - first)))
    for cost in (driver.cost, driver.write_cost):
        assert cost(inner) is not None or cost(span) is None


def fits(driver: ComputerLink, area: str, start: int, *, write: bool = False) -> int:
    """The longest span from `start` on that goes in one exchange."""
    cost = driver.write_cost if write else driver.cost
    return max(size for size in range(1, 600) if cost(Span(area, start, size)))


@pytest.mark.parametrize(
    ("profile", "read", "write"),
    [
        (
            "liyan",
            {"TS": 64, "D": 64, "T": 64, "C32": 16, "M": 512},
            {"TS": 64, "D": 64, "M": 64, "C32": 16},
        ),
        (
            "fx",
            {"TS": 256, "D": 64, "C32": 32, "M": 512},
            {"TS": 160, "D": 64, "M": 160, "C32": 32},
        ),
    ],
)
def test_one_request_has_the_limits_of_the_profile(
    profile: ProfileName, read: dict[str, int], write: dict[str, int]
) -> None:
    driver = ComputerLink(profile=profile)
    for area, size in read.items():
        assert fits(driver, area, driver.areas[area].first) == size, area
    for area, size in write.items():
        assert fits(driver, area, driver.areas[area].first, write=True) == size, area


def test_20_scattered_points_go_in_one_bt_and_10_words_in_one_wt() -> None:
    driver = ComputerLink()
    points = [Span("M", 7 * n, 1) for n in range(21)]
    assert driver.scattered_write_cost(points[:20]) == Cost(8 + 2 + 20 * 6 + 2, 5)
    assert driver.scattered_write_cost(points) is None
    words = [Span("D", 7 * n, 1) for n in range(11)]
    assert driver.scattered_write_cost(words[:10]) == Cost(8 + 2 + 10 * 9 + 2, 5)
    assert driver.scattered_write_cost(words) is None


@pytest.mark.parametrize(
    "spans_",
    [
        [],
        [Span("M", 1, 1), Span("D", 1, 1)],
        [Span("C32", 200, 1)],
        [Span("M", 1, 2), Span("M", 2, 1)],
        [Span("D", 1, 1), Span("D", 1, 1)],
        [Span("M", 1535, 2)],
        [Span("Q", 1, 1)],
        [Span("M", 1, 0)],
    ],
    ids=str,
)
def test_spans_that_do_not_fit_one_write_have_no_cost(spans_: list[Span]) -> None:
    assert ComputerLink().scattered_write_cost(spans_) is None


@pytest.mark.parametrize(
    "spans_",
    [
        [],
        [Span("C32", 200, 1)],
        [Span("TS", 1, 1), Span("D", 1, 1)],
        [Span("TS", n, 1) for n in range(11)],
        [Span("D", 2 * n, 1) for n in range(11)],
        [Span("M", 1535, 2)],
    ],
    ids=str,
)
def test_spans_that_do_not_fit_one_list_have_no_cost(spans_: list[Span]) -> None:
    assert ComputerLink(monitor=True).monitor_cost(spans_) is None


def test_points_beside_words_are_registered_in_sixteens() -> None:
    spans_ = [Span("M", 100, 1), Span("D", 1, 1)]
    assert ComputerLink(monitor=True).monitor_cost(spans_) == Cost(8 + 2, 6 + 2 * 4 + 2)


def test_no_list_is_registered_without_the_setting_monitor() -> None:
    assert ComputerLink().monitor_cost([Span("D", 1, 1)]) is None
    assert ComputerLink(monitor=True).monitor_cost([Span("D", 1, 1)]) is not None


@pytest.mark.parametrize("span", [Span("M", 0, 0), Span("M", 1530, 7), Span("M", -1, 2)], ids=str)
def test_a_span_outside_the_device_has_no_cost(span: Span) -> None:
    assert ComputerLink().cost(span) is None
    assert ComputerLink().write_cost(span) is None


@pytest.mark.parametrize("procedure", PROCEDURES)
async def test_every_command_is_carried_out(procedure: Procedure) -> None:
    driver = ComputerLink(station=5, frame_format=procedure[0], sum_check=procedure[1])
    peer = peer_of(driver)
    wire = Wire(driver, lambda data: [peer.hear(data)])
    assert await driver.control(wire, "run", "") == "acknowledged"
    assert await driver.control(wire, "stop", "") == "acknowledged"
    assert await driver.control(wire, "model", "") == "9D (FX2N)"
    text = "".join(map(chr, range(32, 127)))
    assert await driver.control(wire, "loopback", text) == text
    await driver.resync(wire, None, 70000)
    await driver.control(wire, "global", "on")
    assert wire.sent[-1:] == [peer.enq("FFFFGW01")]
