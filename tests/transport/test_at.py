"""The AT commands, on a virtual clock: against a model of a modem, byte by byte and in pieces."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.transport.at import LOST, NEVER, AtModem
from gateway.transport.modem_events import (
    Broken,
    Connected,
    Ended,
    Event,
    Failed,
    ModemSettings,
    Ready,
    Received,
    Send,
    SetDtr,
    State,
)
from tests.transport.modem import ModemModel

SETTINGS = ModemSettings(
    number="0,26204393", init=("ATZ", "ATX4"), dial_timeout=60.0, guard=1.2, hold=0.05
)


class Bench:
    """A modem of the gateway and a model of a modem, without a cable between them."""

    def __init__(
        self, model: ModemModel | None = None, *, answers: bool = False, piece: int = 100
    ) -> None:
        self.model = model or ModemModel(guard=1.0, after=8.0)
        self.modem = AtModem(SETTINGS, answers=answers)
        self.now = 0.0
        self.piece = piece
        self.events: list[Event] = []
        self.data = b""

    def note(self, events: list[Event]) -> None:
        for event in events:
            match event:
                case Send(data):
                    self.hear(self.model.feed(data, self.now))
                case Received(data):
                    self.data += data
                case _:
                    self.events.append(event)

    def hear(self, data: bytes) -> None:
        for at in range(0, len(data), self.piece):
            self.note(self.modem.feed(data[at : at + self.piece], self.now))

    def run(self, seconds: float = 300.0) -> list[Event]:
        """Lets the time pass until nothing is due. Returns the events since the last call."""
        end = self.now + seconds
        while (due := min(self.modem.due, self.model.due)) <= end:
            self.now = max(self.now, due)
            self.hear(self.model.tick(self.now))
            self.note(self.modem.tick(self.now))
        self.now = end
        events, self.events = self.events, []
        return events

    def open(self) -> None:
        self.note(self.modem.open(self.now))
        assert self.run(30) == [Ready()]

    def connect(self) -> None:
        self.open()
        self.note(self.modem.dial(self.now))
        assert self.run(30) == [Connected("CONNECT 9600")]


@pytest.mark.parametrize("piece", [1, 3, 100])
def test_the_modem_is_set_up_with_echo_and_without(piece: int) -> None:
    bench = Bench(piece=piece)
    bench.open()
    assert bench.model.commands == ["ATE0V1Q0", "ATZ", "ATX4", "ATE0V1Q0", "ATS0=0"]
    assert bench.modem.due == NEVER


def test_a_modem_in_a_call_of_before_hangs_up_first() -> None:
    bench = Bench(ModemModel(guard=1.0, online=True))
    bench.open()
    assert bench.model.commands[0] == "ATH"
    assert not bench.model.online


def test_a_modem_that_does_not_answer_is_broken() -> None:
    bench = Bench(ModemModel(deaf=True))
    bench.note(bench.modem.open(0.0))
    (event,) = bench.run()
    assert isinstance(event, Broken)
    assert "does not answer AT commands" in event.why


def test_the_text_of_an_init_string_is_not_in_the_error() -> None:
    """It may hold a PIN."""
    bench = Bench(ModemModel(errors=frozenset({"ATX4"})))
    bench.note(bench.modem.open(0.0))
    assert bench.run() == [Broken("the modem answers ERROR to init string 2 of 2")]


def test_a_modem_without_s0_is_as_good() -> None:
    bench = Bench(ModemModel(errors=frozenset({"ATS0=0"})))
    bench.open()


@pytest.mark.parametrize("piece", [1, 100])
@pytest.mark.parametrize("word", ["BUSY", "NO CARRIER", "NO DIALTONE", "NO ANSWER", "ERROR"])
def test_a_call_fails_in_the_words_of_the_modem(word: str, piece: int) -> None:
    bench = Bench(ModemModel(dials=(word, "CONNECT 9600"), after=5.0), piece=piece)
    bench.open()
    bench.note(bench.modem.dial(bench.now))
    assert bench.run(10) == [Failed(word)]
    assert bench.model.commands[-1] == "ATDT0,26204393"
    bench.note(bench.modem.dial(bench.now))
    assert bench.run(10) == [Connected("CONNECT 9600")]


def test_b3_8_one_minute_without_a_carrier_ends_the_dial() -> None:
    bench = Bench(ModemModel(dials=("",)))
    bench.open()
    begun = bench.now
    bench.note(bench.modem.dial(begun))
    assert bench.run(59.0) == []
    assert bench.run(5.0) == [Failed("no carrier within 60 s")]
    assert bench.modem.state is State.READY


def test_a_carrier_in_the_moment_of_giving_up_is_hung_up() -> None:
    bench = Bench(ModemModel(dials=("",), guard=1.0))
    bench.open()
    bench.note(bench.modem.dial(bench.now))
    bench.now += 60.0
    text = bench.model.connect()  # the character that breaks off is data now
    bench.note(bench.modem.tick(bench.now))
    bench.hear(text)
    assert bench.run(10) == [Failed("no carrier within 60 s")]
    assert bench.model.commands[-1] == "ATH"
    assert not bench.model.online


def test_a_call_is_ended_by_the_escape_between_two_guard_times() -> None:
    bench = Bench()
    bench.connect()
    bench.note(bench.modem.hang_up(bench.now))
    assert bench.run(10) == [Ready()]
    assert bench.model.commands[-1] == "ATH"
    assert bench.model.data == b""  # nothing of it went to the station


def test_a_call_is_ended_by_dtr_where_there_is_one() -> None:
    bench = Bench()
    bench.modem.pins.dtr = True
    bench.connect()
    bench.note(bench.modem.hang_up(bench.now))
    bench.model.online = False  # it sees the signal
    assert bench.run(10) == [SetDtr(False), SetDtr(True), Ready()]


def test_a_modem_that_does_not_hang_up_is_broken() -> None:
    bench = Bench(ModemModel(after=1.0, guard=1.0, errors=frozenset({"ATH"})))
    bench.connect()
    bench.note(bench.modem.hang_up(bench.now))
    assert bench.run(60) == [Broken("the modem does not hang up")]


def test_a_modem_may_report_the_end_of_the_carrier_alone() -> None:
    bench = Bench(ModemModel(guard=1.0, after=1.0, hung_up="NO CARRIER"))
    bench.connect()
    bench.note(bench.modem.hang_up(bench.now))
    assert bench.run(5) == [Ready()]


def test_nothing_is_dialled_while_the_telephone_rings() -> None:
    bench = Bench()
    bench.open()
    bench.hear(bench.model.ring())
    bench.note(bench.modem.dial(bench.now))
    assert bench.run(1) == [Failed("RING: an incoming call")]


def test_a_call_that_the_modem_took_by_itself_is_ended() -> None:
    bench = Bench(ModemModel(guard=1.0))
    bench.open()
    bench.hear(bench.model.connect())
    assert bench.run(10) == [Ready()]
    assert not bench.model.online


def test_a_ring_is_answered() -> None:
    bench = Bench(answers=True)
    bench.open()
    bench.hear(bench.model.ring())
    assert bench.run(10) == [Connected("CONNECT 9600")]
    assert bench.model.commands[-1] == "ATA"


def test_other_words_of_a_modem_that_waits_are_no_ring() -> None:
    bench = Bench(answers=True)
    bench.open()
    before = list(bench.model.commands)
    bench.hear(b"\r\n+CREG: 1\r\n\r\nCID: 26204393\r\n")
    assert bench.run(10) == []
    assert bench.model.commands == before


def test_a_caller_who_says_nothing_is_hung_up() -> None:
    bench = Bench(answers=True)
    bench.open()
    bench.hear(bench.model.ring())
    assert bench.run(30) == [
        Connected("CONNECT 9600"),
        Ended("the caller was silent for 5 s"),
    ]
    assert bench.modem.state is State.READY


# Data


def test_the_line_feed_of_connect_is_no_data() -> None:
    bench = Bench(piece=1)
    bench.connect()
    bench.hear(b"\x02reply")
    assert bench.data == b"\x02reply"


@pytest.mark.parametrize("piece", [1, 2, 5, 100])
def test_the_text_of_the_modem_is_no_data(piece: int) -> None:
    bench = Bench(piece=piece)
    bench.connect()
    bench.hear(b"VALUE=12" + bench.model.drop())
    assert bench.run(5) == [Ended("NO CARRIER"), Ready()]
    assert bench.data == b"VALUE=12"  # without the line end, which would complete the frame


def test_a_station_that_says_no_carrier_ends_no_call_that_the_signal_cd_shows() -> None:
    bench = Bench()
    bench.connect()
    bench.modem.pins.carrier = True
    said = b"ALARM=" + LOST + b"\r\n\x03"
    bench.hear(said[:20])
    bench.hear(said[20:])
    assert bench.run(5) == []
    assert bench.data == said
    bench.hear(b"ALARM=" + LOST)
    bench.note(bench.modem.carrier_lost())
    assert bench.run(5) == [Ended("NO CARRIER (the signal CD is off)")]
    assert bench.data == said + b"ALARM="


def test_no_number_is_sent_into_a_call_that_a_station_seemed_to_end() -> None:
    """Without the signal CD the text may be data: the modem is asked, and hangs up if need be."""
    bench = Bench()
    bench.connect()
    bench.hear(b"ALARM=" + LOST + b"\r\n")
    bench.note(bench.modem.hang_up(bench.now))
    assert bench.run(60) == [Ended("NO CARRIER"), Ready()]
    assert not bench.model.online
    assert b"ATD" not in bench.model.data


def test_a_line_end_of_a_station_arrives_a_little_later() -> None:
    bench = Bench()
    bench.connect()
    bench.hear(b"VALUE=1234\r\n")
    assert bench.data == b"VALUE=1234"
    bench.run(SETTINGS.hold)
    assert bench.data == b"VALUE=1234\r\n"


def test_the_end_of_a_frame_is_dropped_with_the_carrier() -> None:
    bench = Bench()
    bench.connect()
    bench.hear(b"VALUE=12\r\n")
    bench.note(bench.modem.carrier_lost())
    assert bench.run(5) == [Ended("NO CARRIER (the signal CD is off)")]
    assert bench.data == b"VALUE=12"


@settings(max_examples=60)
@given(st.lists(st.binary(max_size=12) | st.sampled_from([b"\r", b"\r\n", b"\r\nNO", LOST[:-1]])))
def test_all_other_data_passes_unchanged(pieces: list[bytes]) -> None:
    bench = Bench()
    bench.connect()
    sent = b"\x02" + b"".join(pieces)
    if LOST in sent:
        return
    bench.hear(b"\x02")
    for piece in pieces:
        bench.hear(piece)
    bench.run(1)
    assert bench.data == sent


@settings(max_examples=60)
@given(st.lists(st.binary(max_size=20) | st.sampled_from([b"\r\nOK\r\n", b"BUSY\r", b"RING\r\n"])))
def test_any_bytes_lead_to_a_state_in_which_it_can_be_opened(pieces: list[bytes]) -> None:
    bench = Bench()
    bench.note(bench.modem.open(0.0))
    for piece in pieces:
        bench.note(bench.modem.feed(piece, bench.now))
        bench.note(bench.modem.tick(bench.now + 0.5))
    bench.run(600)
    assert bench.modem.state in (State.READY, State.CLOSED)
