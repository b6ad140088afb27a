"""Device addresses as their makers write them."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.errors import ConfigError
from gateway.protocols.devices import parse_device, spell_device
from gateway.protocols.driver import Address, Area, Unit

X = Area("X", Unit.BIT, 0, 0o377, octal=True)
Y = Area("Y", Unit.BIT, 0, 0o377, octal=True)
M = Area("M", Unit.BIT, 0, 1023)
M8 = Area("M8", Unit.BIT, 8000, 8255)
C = Area("C", Unit.WORD, 0, 199)
C32 = Area("C32", Unit.DWORD, 200, 255)
D = Area("D", Unit.WORD, 0, 7999)

TABLE = {"X": (X,), "Y": (Y,), "M": (M, M8), "C": (C, C32), "CN": (C, C32), "D": (D,)}


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("D100", Address("D", 100)),
        ("D0100", Address("D", 100)),
        ("d100", Address("D", 100)),
        ("X17", Address("X", 15)),
        ("X0017", Address("X", 15)),
        ("Y377", Address("Y", 255)),
        ("D7.3", Address("D", 7, 3)),
        ("D7.15", Address("D", 7, 15)),
        ("D7.03", Address("D", 7, 3)),
        ("M8003", Address("M8", 8003)),
        ("C199", Address("C", 199)),
        ("C200", Address("C32", 200)),
        ("cn5", Address("C", 5)),
        ("C5.0", Address("C", 5, 0)),
    ],
)
def test_an_address_is_read_as_its_maker_writes_it(text: str, address: Address) -> None:
    assert parse_device(text, TABLE) == address


@pytest.mark.parametrize(
    ("text", "right"),
    [
        ("X18", "X18: X and Y are numbered in octal, 8 and 9 do not exist"),
        ("Y9", "Y9: X and Y are numbered in octal, 8 and 9 do not exist"),
        ("X400", "X400: X goes from X0 to X377"),
        ("D8000", "D8000: D goes from D0 to D7999"),
        ("M1024", "M1024: M goes from M0 to M1023 and M8000 to M8255"),
        ("C256", "C256: C goes from C0 to C255"),
        ("CN256", "CN256: CN goes from CN0 to CN255"),
        ("Q1", "Q1: there is no device Q; there are X, Y, M, C, CN, D"),
        ("M5.1", "M5.1: M5 is a bit already, write M5"),
        ("C200.0", "C200.0: C200 is 32 bits wide, only 16-bit words have bits"),
        ("C200.31", "C200.31: C200 is 32 bits wide, only 16-bit words have bits"),
        ("D7.16", "D7.16: the bits of a word are .0 to .15"),
    ],
)
def test_a_wrong_address_gets_a_correct_example(text: str, right: str) -> None:
    with pytest.raises(ConfigError) as raised:
        parse_device(text, TABLE)
    assert str(raised.value) == right


@pytest.mark.parametrize(
    "text",
    [
        "",
        "D",
        "100",
        "D 100",
        " D100",
        "D100\n",
        "D100.",
        "D-1",
        "D1.A",
        "D１",
        "D1_0",
        "D" + "1" * 5000,
    ],
)
def test_a_text_that_is_no_address_gets_an_example(text: str) -> None:
    with pytest.raises(ConfigError, match="no device address: write it as D100, a bit of"):
        parse_device(text, TABLE)


def test_one_octal_device_is_spoken_of_in_the_singular() -> None:
    with pytest.raises(ConfigError, match="X8: X is numbered in octal"):
        parse_device("X8", {"X": (X,)})


@given(st.sampled_from([X, Y, M, M8, C, C32, D]), st.data())
def test_spelling_is_the_inverse_of_reading(area: Area, data: st.DataObject) -> None:
    bits = st.none() | st.integers(0, 15) if area.unit is Unit.WORD else st.none()
    number = data.draw(st.integers(area.first, area.last))
    address = Address(area.name, number, data.draw(bits))
    assert parse_device(spell_device(address, TABLE), TABLE) == address


@pytest.mark.parametrize(
    ("address", "text"),
    [
        (Address("X", 15), "X17"),
        (Address("C", 5), "C5"),
        (Address("C32", 200), "C200"),
        (Address("M8", 8003), "M8003"),
        (Address("D", 7, 3), "D7.3"),
    ],
)
def test_an_address_is_spelled_as_its_maker_writes_it(address: Address, text: str) -> None:
    assert spell_device(address, TABLE) == text


def test_an_area_of_another_device_cannot_be_spelled() -> None:
    with pytest.raises(ConfigError, match="there is no area holding"):
        spell_device(Address("holding", 1), TABLE)


@given(
    st.text(max_size=12) | st.from_regex(r"[A-Z]{1,2}[0-9]{1,10}(\.[0-9]{1,10})?", fullmatch=True)
)
def test_any_text_is_an_address_or_a_config_error(text: str) -> None:
    try:
        address = parse_device(text, TABLE)
    except ConfigError:
        return
    assert parse_device(spell_device(address, TABLE), TABLE) == address
