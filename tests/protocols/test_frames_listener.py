"""Listening: unasked frames in order, silence that ends frames and values, nothing that grows."""

from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.errors import Garbled
from gateway.protocols.frames import Field, Frames, Framing, Listen, Listener
from gateway.protocols.unsolicited import Stale, UnsolicitedEvent, UnsolicitedFrame
from tests.protocols.frames_examples import device
from tests.protocols.test_frames_device import OVERLOAD, STABLE
from tests.vectors import vectors

K120S = {v.id: v.frame for v in vectors("noproto-k120s")}


def quiet(one: Frames, now: float = 0.0) -> Listener:
    """Listens to a device that was silent since the port was opened."""
    listener = Listener(one, now)
    listener.tick(now + 0.05)
    return listener


def weights(said: list[UnsolicitedEvent]) -> list[object]:
    return [item.values["weight"] for item in said if isinstance(item, UnsolicitedFrame)]


def test_frames_are_decoded_in_order_in_any_pieces() -> None:
    listener = Listener(device("reader"), now=0.0)
    stream = b"".join(b"\x02CODE-%d\x03" % number for number in (1, 1, 2))
    said = [item for octet in stream for item in listener.received(bytes([octet]), now=5.0)]
    assert [item.values for item in said if isinstance(item, UnsolicitedFrame)] == [
        {"barcode": "CODE-1"},
        {"barcode": "CODE-1"},
        {"barcode": "CODE-2"},
    ]


def test_a_silent_device_needs_no_time() -> None:
    listener = Listener(device("reader"), now=0.0)
    assert listener.due is None
    listener.received(b"\x02CODE-1\x03", now=1.0)
    assert listener.due is None


def test_a_frame_that_began_before_the_port_opened_is_discarded() -> None:
    listener = Listener(device("scale"), now=0.0)
    said = listener.received(b"5.5  g\r\n" + STABLE, now=0.01)
    assert weights(said) == [1234.5]
    assert len(said) == 1


def test_the_first_frame_after_a_silence_is_taken() -> None:
    listener = quiet(device("scale"))
    assert weights(listener.received(STABLE, now=0.3)) == [1234.5]


def test_a_tail_that_waited_while_the_process_stood_still_is_no_frame() -> None:
    """The port was opened within `+001234.5`. Nothing tells when the bytes arrived."""
    for stopped in (0.06, 0.15, 9.0):
        listener = Listener(device("scale"), now=0.0)
        for _ in range(3):  # the loop goes on: the timer first, or the bytes, which need two rounds
            listener.tick(now=stopped)
        assert weights(listener.received(STABLE[-12:], now=stopped)) == []
        assert weights(listener.received(STABLE, now=stopped + 0.01)) == [1234.5]


def test_a_tick_that_is_late_is_asked_again_four_times_and_then_counts() -> None:
    listener = Listener(device("scale"), now=0.0)
    for _ in range(4):
        listener.tick(now=0.15)
        assert listener.due == 0.05
    listener.tick(now=0.151)
    assert weights(listener.received(STABLE, now=0.2)) == [1234.5]


def test_an_unknown_frame_is_reported_as_garbled() -> None:
    listener = quiet(device("scale"))
    said = listener.received(STABLE + OVERLOAD + STABLE, now=1.0)
    assert weights(said) == [1234.5, 1234.5]
    assert isinstance(said[1], Garbled)
    assert said[1].data == OVERLOAD.rstrip()


def test_a_frame_that_is_known_and_means_nothing_is_no_damage() -> None:
    one = Frames(
        framing=Framing(ending="CR LF"),
        listen={
            "weight": Listen(
                match="ST,(?P<weight>.{9}).*", fields={"weight": Field(type="decimal")}
            ),
            "overload": Listen(match="OL.*"),
        },
    )
    said = quiet(one).received(STABLE + OVERLOAD, now=1.0)
    assert said == [
        UnsolicitedFrame("weight", {"weight": 1234.5}),
        UnsolicitedFrame("overload", {}),
    ]


def test_a_streaming_scale_that_stops_becomes_stale_once() -> None:
    listener = quiet(device("scale"))
    listener.received(STABLE, now=1.0)
    assert listener.due == 3.0
    assert listener.tick(now=2.9) == []
    assert listener.tick(now=3.0) == [Stale(frozenset({"weight", "state", "unit"}))]
    assert listener.due is None
    assert listener.tick(now=9.0) == []
    listener.received(STABLE, now=10.0)
    assert listener.due == 12.0


def test_a_scale_that_never_sent_becomes_stale_too() -> None:
    listener = quiet(device("scale"), now=100.0)
    assert listener.due == 102.0
    assert listener.tick(now=102.0) == [Stale(frozenset({"weight", "state", "unit"}))]


def test_a_value_of_a_frame_without_stale_after_stays_known() -> None:
    weight = {"weight": Field(type="decimal")}
    one = Frames(
        framing=Framing(ending="CR LF"),
        listen={
            "streamed": Listen(match="ST,(?P<weight>.{9}).*", fields=weight, stale_after=2.0),
            "printed": Listen(match="P(?P<weight>.*)", fields=weight),
        },
    )
    listener = quiet(one)
    listener.received(STABLE, now=1.0)
    listener.received(b"P12.5\r\n", now=2.0)
    assert listener.due is None


def test_consecutive_damage_is_reported_once() -> None:
    said = quiet(device("scale")).received(OVERLOAD * 1000, now=1.0)
    assert [type(item) for item in said] == [Garbled]


def test_damage_does_not_keep_a_value_alive() -> None:
    listener = quiet(device("scale"))
    listener.received(STABLE, now=1.0)
    listener.received(OVERLOAD, now=2.5)
    assert listener.due == 3.0


def test_a_gap_ends_a_frame_that_nothing_else_ends() -> None:
    one = Frames(
        framing=Framing(gap=0.05),
        listen={"any": Listen(match="(?P<text>.*)", fields={"text": Field(type="text")})},
    )
    listener = quiet(one)
    assert listener.received(b"AB", now=1.0) == []
    assert listener.received(b"C", now=1.03) == []
    assert listener.due == 1.03 + 0.05
    assert listener.tick(now=1.07) == []
    assert listener.tick(now=1.08) == [UnsolicitedFrame("any", {"text": "ABC"})]
    assert listener.due is None


def test_bytes_of_a_line_that_was_late_are_no_frame() -> None:
    one = Frames(
        framing=Framing(gap=0.05),
        listen={"any": Listen(match="(?P<text>.*)", fields={"text": Field(type="text")})},
    )
    listener = quiet(one)
    listener.received(b"AB", now=1.0)
    (waited,) = listener.received(b"CD", now=1.2)
    assert isinstance(waited, Garbled)  # the gap may have been within a frame
    assert listener.tick(now=1.25) == []
    assert listener.received(b"EF", now=1.3) == []
    assert listener.tick(now=1.35) == [UnsolicitedFrame("any", {"text": "EF"})]


def test_half_a_frame_is_void_after_a_long_pause_even_without_a_gap() -> None:
    listener = quiet(device("scale"))
    assert listener.received(STABLE[:5], now=1.0) == []
    damage, _ = listener.tick(now=2.0)
    assert isinstance(damage, Garbled)
    assert weights(listener.received(STABLE, now=60.0)) == [1234.5]


def test_after_others_spoke_only_a_frame_that_began_afterwards_is_taken() -> None:
    listener = quiet(device("scale"))
    listener.received(STABLE[:5], now=1.0)
    listener.restart(now=1.1, whole=False)
    assert weights(listener.received(STABLE[5:] + STABLE, now=1.11)) == [1234.5]


def test_after_a_whole_reply_a_frame_needs_no_silence() -> None:
    listener = quiet(device("scale"))
    listener.restart(now=1.1, whole=True)
    assert weights(listener.received(STABLE, now=1.11)) == [1234.5]


def test_after_a_reply_that_ended_by_its_count_a_terminator_may_follow() -> None:
    frames = Frames(
        framing=Framing(terminator="<CR>", max_length=2, ends=("terminator", "count")),
        listen={"any": Listen(match="(?P<text>.+)", fields={"text": Field(type="text")})},
    )
    listener = quiet(frames)
    listener.restart(now=1.1, whole=True)
    assert listener.received(b"\rAB\r", now=1.11) == [UnsolicitedFrame("any", {"text": "AB"})]


def test_the_k120s_weighing_machine_gets_its_answer() -> None:
    one = device("weighing")
    (heard,) = quiet(one).received(K120S["noproto-k120s-001"], now=1.0)
    assert isinstance(heard, UnsolicitedFrame)
    assert heard.reply is not None
    assert one.codec().encode(heard.reply) == K120S["noproto-k120s-002"]


steps = st.lists(
    st.tuples(
        st.sampled_from([b"", STABLE, OVERLOAD, STABLE[:7], b"\r\n"]) | st.binary(max_size=40),
        st.floats(0, 3),
    ),
    max_size=12,
)


@settings(max_examples=150)
@given(steps, st.sampled_from(["scale", "scale-by-columns", "reader", "weighing"]))
def test_whatever_comes_and_whenever_a_listener_tells_and_never_fails(
    steps: list[tuple[bytes, float]], name: str
) -> None:
    listener, now = Listener(device(name), now=0.0), 0.0
    for data, pause in steps:
        now += pause
        said = listener.received(data, now)
        for _ in range(5):
            said += listener.tick(now)
        assert all(isinstance(item, UnsolicitedFrame | Garbled | Stale) for item in said)
        assert listener.due is None or listener.due > now
