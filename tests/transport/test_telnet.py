"""The telnet filter: any chopping gives the same, any bytes never raise, FF survives."""

from hypothesis import example, given, settings
from hypothesis import strategies as st

from gateway.transport.telnet import (
    BINARY,
    COM_PORT,
    Acknowledged,
    Agreed,
    Consent,
    Event,
    Received,
    Send,
    Setting,
    Telnet,
)

# RFC 854: IAC 255, SE 240, NOP 241, SB 250, WILL 251, WONT 252, DO 253, DONT 254.
# RFC 857: ECHO 1. RFC 2217 section 3: the server's answers are numbered 100 above the requests.
IAC, SE, NOP, SB, WILL, WONT, DO, DONT = 255, 240, 241, 250, 251, 252, 253, 254
ECHO = 1

pieces_of_telnet = st.lists(
    st.one_of(
        st.binary(max_size=8),
        st.sampled_from(
            [
                bytes(row)
                for row in (
                    [IAC], [IAC, IAC], [IAC, NOP], [IAC, SB, COM_PORT, 101], [IAC, SE],
                    [IAC, DO, COM_PORT], [IAC, WILL, ECHO], [IAC, DONT, BINARY],
                    [IAC, SB, COM_PORT, 101, 0, 0, IAC, IAC, 1, IAC, SE],
                )
            ]
        ),
    ),
    max_size=20,
).map(b"".join)  # fmt: skip


def joined(events: list[Event]) -> list[Event]:
    """With neighbouring pieces of data put together."""
    row: list[Event] = []
    for event in events:
        match row, event:
            case [*_, Received(before)], Received(after):
                row[-1] = Received(before + after)
            case _:
                row.append(event)
    return row


def begun() -> Telnet:
    telnet = Telnet()
    telnet.start()
    return telnet


@given(st.binary(max_size=300))
def test_encoded_data_is_decoded_unchanged(data: bytes) -> None:
    heard = b"".join(e.data for e in Telnet().feed(Telnet.encode(data)) if isinstance(e, Received))
    assert heard == data


@settings(max_examples=300)
@given(pieces_of_telnet, st.data())
def test_any_chopping_gives_the_same_events(stream: bytes, draw: st.DataObject) -> None:
    cuts = sorted(draw.draw(st.lists(st.integers(0, len(stream)), max_size=10)))
    whole, chopped, bytewise = begun(), begun(), begun()
    events = joined(whole.feed(stream))
    parts = [stream[a:b] for a, b in zip([0, *cuts], [*cuts, len(stream)], strict=True)]
    assert joined([e for part in parts for e in chopped.feed(part)]) == events
    assert joined([e for i in stream for e in bytewise.feed(bytes((i,)))]) == events


@given(st.lists(st.binary(max_size=40), max_size=10))
def test_no_bytes_raise(stream: list[bytes]) -> None:
    telnet = begun()
    for part in stream:
        for event in telnet.feed(part):
            assert isinstance(event, Received | Send | Agreed | Acknowledged)


@given(pieces_of_telnet, st.binary(max_size=20).filter(lambda data: IAC not in data))
def test_data_is_received_again_after_any_noise(noise: bytes, data: bytes) -> None:
    telnet = begun()
    telnet.feed(noise)
    telnet.feed(bytes((IAC, SE, IAC, SE)))  # ends whatever had begun
    telnet.feed(bytes(400))  # longer than any subnegotiation
    heard = b"".join(e.data for e in telnet.feed(data) if isinstance(e, Received))
    assert heard == data


@given(
    st.lists(st.sampled_from([bytes((v, o)) for v in (WILL, WONT, DO, DONT) for o in range(50)]))
)
@example([bytes((WILL, 44)), bytes((WONT, 44)), bytes((WILL, 44))])
def test_two_clients_do_not_answer_each_other_forever(opening: list[bytes]) -> None:
    ends = begun(), begun()
    on_the_way = b"".join(bytes((IAC,)) + verb for verb in opening)
    for turn in range(6):
        events = ends[turn % 2].feed(on_the_way)
        on_the_way = b"".join(event.data for event in events if isinstance(event, Send))
    assert on_the_way == b""


def test_a_request_doubles_ff_in_its_number() -> None:
    # RFC 2217 section 2: a 255 within a value is sent twice.
    request = Telnet.request(Setting.BAUDRATE, 0xFF00)
    assert request == bytes((IAC, SB, COM_PORT, 1, 0, 0, IAC, IAC, 0, IAC, SE))


def test_an_acknowledgement_with_ff_in_its_number_is_understood() -> None:
    answer = bytes((IAC, SB, COM_PORT, 101, 0, 0, IAC, IAC, 0, IAC, SE))
    assert Telnet().feed(answer) == [Acknowledged(Setting.BAUDRATE, 0xFF00)]


def test_data_around_a_subnegotiation_keeps_its_place() -> None:
    note = bytes((IAC, SB, COM_PORT, 103, 3, IAC, SE))
    assert Telnet().feed(b"before" + note + b"after") == [
        Received(b"before"),
        Acknowledged(Setting.PARITY, 3),
        Received(b"after"),
    ]


def test_com_port_agreed_and_refused() -> None:
    yes, no = begun(), begun()
    assert yes.feed(bytes((IAC, DO, COM_PORT))) == [Agreed(COM_PORT, ours=True, yes=True)]
    assert no.feed(bytes((IAC, DONT, COM_PORT))) == [Agreed(COM_PORT, ours=True, yes=False)]
    assert yes.consent(COM_PORT, ours=True) is Consent.YES
    assert no.consent(COM_PORT, ours=True) is Consent.DECLINED


def test_echo_is_declined_and_com_port_of_the_server_is_accepted() -> None:
    telnet = begun()
    assert telnet.feed(bytes((IAC, WILL, ECHO))) == [Send(bytes((IAC, DONT, ECHO)))]
    assert telnet.feed(bytes((IAC, WILL, COM_PORT))) == [
        Send(bytes((IAC, DO, COM_PORT))),
        Agreed(COM_PORT, ours=False, yes=True),
    ]


def test_an_endless_subnegotiation_does_not_swallow_the_data() -> None:
    telnet = Telnet()
    telnet.feed(bytes((IAC, SB, COM_PORT)) + bytes(300))
    assert telnet.feed(b"data") == [Received(b"data")]


def test_long_runs_of_escapes_take_linear_time() -> None:
    data = bytes((IAC,)) * 200_000
    assert joined(Telnet().feed(data)) == [Received(bytes((IAC,)) * 100_000)]
