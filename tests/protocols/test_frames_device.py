"""Frames: the four conversations, with the worked examples of the manuals and of the page."""

import copy
from typing import Any

import pytest
from pydantic import ValidationError

from gateway.errors import BadValue, ConfigError, Garbled, NoReply, Refused, Unclear
from gateway.protocols.frames import Ask, Field, Frames, Framing, Listen, Write
from gateway.protocols.unsolicited import UnsolicitedFrame
from gateway.stations.vigor import VigorStation
from tests.doubles import Script
from tests.protocols.frames_examples import device, documented, load
from tests.vectors import vectors

BY_ID = {v.id: v for v in vectors("noproto-vb1com", "noproto-k120s", "vigor")}


def line(direction: str, name: str) -> str:
    return f"{direction} {BY_ID[name].frame.hex(' ')}"


def script(device: Frames, *lines: str) -> Script:
    return Script(device, *lines)  # type: ignore[arg-type]  # it asks for a codec, no more


PROGRAMS = ["vigor-as-text", "vigor-converted"]


@pytest.mark.parametrize("name", PROGRAMS)
async def test_b_4_5_both_programs_read_d0_of_station_1(name: str) -> None:
    talk = script(device(name), line(">", "vigor-012"), line("<", "noproto-vb1com-019"))
    assert await device(name).read(talk, "read-d0") == {"d0": 0x1234}
    talk.done()


@pytest.mark.parametrize("name", PROGRAMS)
async def test_b_4_5_both_programs_write_d1_of_station_1(name: str) -> None:
    one = device(name)
    station = VigorStation(1)
    request = one.codec().encode(one.write["d1"].frame(one.put("d1", -2)))
    reply = station.hear(request, 0.0)
    assert reply == [BY_ID["noproto-vb1com-021"].frame]
    assert station.memory.read("D", 1) == [0xFFFE]
    talk = script(one, f"> {request.hex(' ')}", line("<", "noproto-vb1com-021"))
    assert await one.tell(talk, "d1", one.put("d1", -2)) is True
    talk.done()


@pytest.mark.parametrize("name", PROGRAMS)
async def test_both_programs_read_the_values_of_a_vigor_station(name: str) -> None:
    one = device(name)
    station = VigorStation(1)
    station.memory.write("D", 0, [0xA325])
    request = one.codec().encode(b"01511C0002" if name == PROGRAMS[0] else b"\x01\x51\x1c\x00\x02")
    (reply,) = station.hear(request, 0.0)
    talk = script(one, f"> {request.hex(' ')}", f"< {reply.hex(' ')}")
    assert await one.read(talk, "read-d0") == {"d0": 0xA325 - 0x10000}


@pytest.mark.parametrize("name", PROGRAMS)
async def test_a_status_other_than_00_is_refused_with_its_code(name: str) -> None:
    one = device(name)
    station = VigorStation(1, holes=[("D", 0), ("D", 1)])
    (reply,) = station.hear(BY_ID["vigor-012"].frame, 0.0)
    talk = script(one, line(">", "vigor-012"), f"< {reply.hex(' ')}")
    with pytest.raises(Refused) as caught:
        await one.read(talk, "read-d0")
    assert caught.value.code == "28"
    request = one.codec().encode(one.write["d1"].frame(one.put("d1", 1)))
    (reply,) = station.hear(request, 0.0)
    with pytest.raises(Refused) as caught:
        await one.tell(
            script(one, f"> {request.hex(' ')}", f"< {reply.hex(' ')}"), "d1", one.put("d1", 1)
        )
    assert caught.value.code == "28"


@pytest.mark.parametrize("name", PROGRAMS)
async def test_the_reply_to_something_else_is_no_answer(name: str) -> None:
    one = device(name)
    talk = script(one, line(">", "vigor-012"), line("<", "noproto-vb1com-021"))
    with pytest.raises(Garbled, match="no answer"):
        await one.read(talk, "read-d0")


async def test_silence_is_no_reply() -> None:
    with pytest.raises(NoReply):
        await device(PROGRAMS[0]).read(
            script(device(PROGRAMS[0]), line(">", "vigor-012")), "read-d0"
        )


@pytest.mark.parametrize("name", PROGRAMS)
def test_a_value_that_does_not_fit_is_refused_before_anything_is_sent(name: str) -> None:
    one = device(name)
    for value in (0x8000, 1.5, "1", True):
        with pytest.raises(BadValue):
            one.put("d1", value)


def test_a_text_that_its_framing_cannot_carry_is_refused_before_anything_is_sent() -> None:
    one = Frames(
        framing=Framing(terminator="**"),
        write={"text": Write(send="PRINT {value}", value=Field(type="text"))},
    )
    assert one.put("text", "A*B") == b"A*B"
    with pytest.raises(BadValue):
        one.put("text", "A**RESET")


def test_only_the_whole_reply_is_an_acknowledgement() -> None:
    write = Write(send="S{value}", value=Field(type="integer"), match="OK")
    assert write.answers(b"OK") is True
    assert write.answers(b"OKAY?") is None
    assert write.answers(b"NOT OK") is None
    weight = {"weight": Field(type="decimal")}
    assert Ask(send="W", match="(?P<weight>[0-9.]{4})", fields=weight).answers(b"12.50") is None


def test_the_k120s_weighing_machine_is_answered_ack_station_ok_eot() -> None:
    one = device("weighing")
    (frame,) = one.codec().feed(BY_ID["noproto-k120s-001"].frame)
    heard = one.decode(frame)
    assert heard is not None
    assert heard.values == {"station": "0", "weight": 0x3412}
    assert heard.reply is not None
    assert one.codec().encode(heard.reply) == BY_ID["noproto-k120s-002"].frame


def test_a_weighing_frame_of_another_shape_is_not_answered() -> None:
    frame = BY_ID["noproto-k120s-001"].frame
    assert device("weighing").decode(frame[:3] + frame[4:]) is None


def test_a_frame_with_a_field_that_cannot_be_read_is_not_answered() -> None:
    one = Frames(
        framing=Framing(terminator="<03>"),
        listen={
            "weight": Listen(
                match="W(?P<weight>.*)",
                fields={
                    "weight": Field(type="decimal"),
                    "first": Field(type="text", columns="1-1"),
                },
                answer="OK",
            )
        },
    )
    assert one.decode(b"W1.5") == UnsolicitedFrame("weight", {"weight": 1.5, "first": "W"}, b"OK")
    heard = one.decode(b"W1.x")
    assert heard is not None
    assert heard.reply is None
    assert heard.values["first"] == "W"  # one bad field does not take the others with it
    assert isinstance(heard.values["weight"], Garbled)
    assert heard.values["weight"].data == b"W1.x"


# The A&D EK-L manual's data format, 9-2: header, sign, digits, unit, CR LF.
STABLE = b"ST,+001234.5  g\r\n"
OVERLOAD = b"OL,+999999.9  g\r\n"


@pytest.mark.parametrize("name", ["scale", "scale-by-columns"])
def test_a_scale_by_pattern_or_by_columns(name: str) -> None:
    one = device(name)
    stable, overload = one.codec().feed(STABLE + OVERLOAD)
    heard = one.decode(stable)
    assert heard is not None
    assert (heard.values["weight"], heard.values["state"]) == (1234.5, "ST")
    assert heard.reply is None
    assert one.decode(overload) is None


def test_a_barcode_between_start_and_end_code() -> None:
    one = device("reader")
    frames = one.codec().feed(b"\x02400638133393-1\x03" * 2)
    assert [one.decode(frame) for frame in frames] == [
        UnsolicitedFrame("scan", {"barcode": "400638133393-1"})
    ] * 2


def inverter(text: str) -> str:
    """A frame of the page's inverter, with the sum as its framing has it."""
    data = text.encode() + b"\x03"
    return (b"\x02" + data + b"%02X" % (sum(data) % 256)).hex(" ")


async def test_an_inverter_is_read_by_ascii_command() -> None:
    one = device("inverter")
    talk = script(one, f"> {inverter('F?')}", f"< {inverter('F=049.98')}")
    assert await one.read(talk, "frequency") == {"frequency": 49.98}
    talk = script(one, f"> {inverter('S=025.00')}", f"< {inverter('OK')}")
    assert await one.tell(talk, "setpoint", one.put("setpoint", 25)) is True
    talk = script(one, f"> {inverter('S=099.90')}", f"< {inverter('ER07')}")
    with pytest.raises(Refused, match="code 07"):
        await one.tell(talk, "setpoint", one.put("setpoint", 99.9))


async def test_a_reply_field_that_cannot_be_read_is_its_own_failure() -> None:
    one = device("inverter")
    talk = script(one, f"> {inverter('F?')}", f"< {inverter('F=0.49.9')}")
    values = await one.read(talk, "frequency")
    assert isinstance(values["frequency"], Garbled)
    assert "frequency: no decimal number" in str(values["frequency"])


async def test_a_write_without_acknowledgement_is_not_reported_as_done() -> None:
    one = Frames(
        framing=Framing(terminator="<0D>"),
        write={"text": Write(send="PRINT {value}", value=Field(type="text"))},
    )
    talk = script(one, "> " + b"PRINT AB\r".hex(" "))
    assert await one.tell(talk, "text", one.put("text", "AB")) is False
    talk.done()
    assert one.write_cost("text") == (512 + 1, 0)  # the longest text that fits


@pytest.mark.parametrize("may_echo", [True, False])
async def test_an_acknowledgement_that_repeats_the_command_may_be_its_echo(may_echo: bool) -> None:
    """Then the device must say it, too."""
    one = Frames(
        framing=Framing(terminator="<0D>"),
        write={
            "set": Write(
                send="S{value}", value=Field(type="integer", format="04d"), match="S[0-9]{4}"
            )
        },
    )
    said = b"S1234\r".hex(" ")
    once, twice = (
        script(one, f"> {said}", f"< {said}"),
        script(one, f"> {said}", *[f"< {said}"] * 2),
    )
    once.may_echo = twice.may_echo = may_echo
    assert await one.tell(twice, "set", one.put("set", 1234)) is True
    if may_echo:
        with pytest.raises(Unclear):
            await one.tell(once, "set", one.put("set", 1234))
    else:
        assert await one.tell(once, "set", one.put("set", 1234)) is True


def test_costs_are_exact_for_the_request_and_the_longest_for_the_reply() -> None:
    for name in PROGRAMS:
        assert device(name).cost("read-d0").request == len(BY_ID["vigor-012"].frame)
    assert device("inverter").write_cost("setpoint").request == len(inverter("S=001.00").split())
    assert device("scale").cost is not None
    framing = Framing(header="<02>", terminator="<03>", sum_check=True, max_length=8, ending="CR")
    one = Frames(
        framing=framing,
        ask={"a": Ask(send="A", match="(?P<b>.*)", fields={"b": Field(type="text")})},
    )
    assert one.cost("a") == (6, 13)


def test_an_unknown_field_gets_the_names_of_all_fields() -> None:
    one = device("inverter")
    assert one.listened == frozenset()
    assert one.asked == {"frequency": "frequency"}
    assert device("scale").listened == {"weight", "state", "unit"}
    with pytest.raises(ConfigError, match=r"'speed' is no field .* it has frequency, setpoint"):
        one.field_of("speed")


@pytest.mark.parametrize("name", documented())
def test_every_device_of_the_page_is_a_device(name: str) -> None:
    assert device(name).protocol == "frames"


def changed(name: str, *path: str, to: Any) -> dict[str, Any]:
    settings = copy.deepcopy(documented()[name])
    del settings["tags"]
    inner = settings
    for step in path[:-1]:
        inner = inner[step]
    inner[path[-1]] = to
    return settings


@pytest.mark.parametrize(
    ("settings", "place", "message"),
    [
        (
            changed("reader", "framing", "header", to="<STX><STX>"),
            (),
            "framing: vigor-rs has a header of one byte",
        ),
        (
            changed("reader", "send_framing", to={"preset": "k120s-drcv"}),
            (),
            "send_framing: k120s-drcv ends by length or by terminator",
        ),
        (changed("scale", "framing", "ending", to="LF"), ("framing", "ending"), "'CR'"),
        (changed("scale", "framing", "gap", to="15ms"), ("framing",), "steps of 10 ms"),
        (
            changed("scale", "listen", "weighing", "match", to="("),
            ("listen", "weighing"),
            "regular",
        ),
        (
            changed("scale", "listen", "weighing", "fields", "net", to={"type": "decimal"}),
            ("listen", "weighing"),
            "field net: give its offset or columns, or name a group",
        ),
        (
            changed("scale", "listen", "weighing", "fields", "unit", to={"type": "kg"}),
            ("listen", "weighing", "fields", "unit", "type"),
            "'decimal'",
        ),
        (
            changed("scale", "listen", "weighing", "fields", to={"weight": {"type": "decimal"}}),
            ("listen", "weighing"),
            "group state: add a field",
        ),
        (
            changed("scale", "listen", "weighing", "stale_after", to="0s"),
            ("listen", "weighing"),
            "longer than zero",
        ),
        (
            changed("weighing", "listen", "weighing", "answer", to="<ACK>{gross}"),
            ("listen", "weighing"),
            "{gross} is none of its fields: station, weight",
        ),
        (
            changed("inverter", "ask", "frequency", "send", to="F{value}"),
            ("ask", "frequency"),
            "nothing can be filled in",
        ),
        (changed("inverter", "ask", "frequency", "send", to="F<ETX>"), (), "cannot be sent"),
        (
            changed("inverter", "ask", "frequency", "refused", to="(?P<error>.*)"),
            ("ask", "frequency"),
            "one named group at most, code",
        ),
        (
            changed("inverter", "write", "setpoint", "send", to="S="),
            ("write", "setpoint"),
            "needs {value} exactly once",
        ),
        (
            changed("inverter", "write", "setpoint", "send", to="S={value:06.2f}"),
            ("write", "setpoint"),
            "write the format in its field",
        ),
        (
            changed("inverter", "write", "setpoint", "value", to={"type": "decimal"}),
            ("write", "setpoint"),
            "needs a format",
        ),
        (
            changed(
                "inverter", "write", "setpoint", "value", to={"type": "text", "columns": "1-2"}
            ),
            ("write", "setpoint"),
            "no offset, columns",
        ),
        (
            changed("inverter", "write", "setpoint", "match", to=None),
            ("write", "setpoint"),
            "for the acknowledgement",
        ),
        (
            changed(
                "inverter", "write", "frequency", to={"send": "{value}", "value": {"type": "text"}}
            ),
            (),
            "frequency cannot be number and text at once",
        ),
        (
            changed("inverter", "write", "1st", to={"send": "{value}", "value": {"type": "text"}}),
            (),
            "letters, digits and _",
        ),
        (
            changed(
                "inverter",
                *("ask", "again"),
                to={
                    "send": "G?",
                    "match": "(?P<frequency>.*)",
                    "fields": {"frequency": {"type": "decimal"}},
                },
            ),
            (),
            "frequency is a field of frequency, again: keep one of them",
        ),
        ({"protocol": "frames", "framing": {}}, (), "at least one of listen, ask and write"),
    ],
)
def test_a_mistake_is_reported_with_its_place(
    settings: dict[str, Any], place: tuple[str, ...], message: str
) -> None:
    with pytest.raises(ValidationError) as caught:
        load(settings)
    (error,) = caught.value.errors()
    assert error["loc"] == place
    assert message in error["msg"]


def test_a_pattern_that_could_take_long_is_refused_for_the_longest_frame_there_is() -> None:
    match = "(.*)=(.*)=(?P<weight>.*)"
    fields = {"weight": Field(type="decimal")}
    Frames(
        framing=Framing(ending="CR", max_length=32),
        listen={"w": Listen(match=match, fields=fields)},
    )
    with pytest.raises(ConfigError, match="lower max_length"):
        Frames(framing=Framing(ending="CR"), listen={"w": Listen(match=match, fields=fields)})
