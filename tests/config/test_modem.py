"""`port: modem:…` and the settings of the modem."""

from pathlib import Path
from typing import Any

import pytest

from gateway.config import Config, ConfigErrors, built
from gateway.transport import ModemAddress, SerialPath
from gateway.transport.modem_events import dial_command

PUMP = {"protocol": "vigor", "station": 1, "tags": {"level": {"address": "D100"}}}
VR1 = {**PUMP, "accept": ["D100"]}


def line(modem: Any = None, port: str = "modem:/dev/ttyS0", **rest: Any) -> Config:
    settings = {} if modem is None else {"modem": modem}
    devices = {"vr1": VR1} if rest.get("serve") else {"pump": PUMP}
    return built({"lines": {"far": {"port": port, "devices": devices, **settings, **rest}}}, Path())


def mistake(*args: Any, **rest: Any) -> str:
    with pytest.raises(ConfigErrors) as found:
        line(*args, **rest)
    return str(found.value)


def test_the_defaults_are_those_of_b3_8() -> None:
    [far] = line({"number": "0,2620-4393"}).lines
    assert far.port == ModemAddress(SerialPath("/dev/ttyS0"))
    assert far.modem is not None
    assert (far.modem.dial_timeout, far.modem.tries) == (60, 3)
    assert dial_command(far.modem.number) == "ATDT0,26204393"
    assert far.modem.init == ("ATZ",)


def test_a_number_may_say_how_it_is_dialled() -> None:
    [far] = line({"number": "P2620 4393", "init": ["AT&F", "ATX3"]}).lines
    assert far.modem is not None
    assert dial_command(far.modem.number) == "ATDP26204393"
    assert far.modem.init == ("AT&F", "ATX3")


def test_a_line_that_answers_needs_no_modem_section() -> None:
    [center] = line(serve=True).lines
    assert center.modem is not None
    assert center.modem.idle == 60
    assert center.devices[0].served is not None
    assert center.devices[0].served.stale_after == float("inf")


@pytest.mark.parametrize("number", [26204393, "", "12;+++", "12\rATD1", "phone", ",,"])
def test_a_number_has_digits_and_is_in_quotes(number: object) -> None:
    assert "number: " in mistake({"number": number})


@pytest.mark.parametrize("init", ["X4", "ATZ\rATD1", 5, ["ATZ", "+++"]])
def test_an_init_string_is_one_command(init: object) -> None:
    assert "init: " in mistake({"number": "1", "init": init})


def test_mistakes_say_what_would_be_right() -> None:
    assert "modem: missing: write the number that it dials" in mistake()
    assert "did you mean guard?" in mistake({"number": "1", "guards": "1s"})
    assert "the port has no modem" in mistake({"number": "1"}, port="/dev/ttyS0")
    assert "answers calls, it never dials" in mistake({"number": "1"}, serve=True)
    assert "only if it dials or answers" in mistake({"number": "1"}, listen_only=True)
    assert "modem:ttyS0" not in mistake({"number": "1"}, port="modem:ttyS0")
    assert "did you mean /dev/ttyS0?" in mistake({"number": "1"}, port="modem:ttyS0")
    lines = {
        "a": {"port": "modem:/dev/ttyS0", "modem": {"number": "1"}, "devices": {"a": PUMP}},
        "b": {"port": "/dev/ttyS0", "devices": {"b": PUMP}},
    }
    with pytest.raises(ConfigErrors, match="line a has this port already"):
        built({"lines": lines}, Path())
