"""Health of one device: the table of its states, and each method."""

import itertools

import pytest

from gateway.engine.device.health import (
    MOST_UNANSWERED,
    TRANSITIONS,
    Event,
    Health,
    Heard,
    State,
    diagnosis,
)
from gateway.engine.device.probe_pace import (
    HOPE_FOR,
    PAUSE_ALIVE,
    PAUSE_FIRST,
    PAUSE_LATE,
    PROBE_PAUSE,
)
from gateway.engine.schedule.probes import is_noisy
from gateway.errors import NO_TROUBLE, Evidence, Garbled, GatewayError, LineDown, NoReply, Unclear
from gateway.protocols.driver import Span
from gateway.tags import Reason
from tests.engine.rig import link_device

S, E = State, Event
SPAN, OTHER = Span("D", 0, 10), Span("D", 50, 1)
SILENCE = NoReply("no reply")
TABLE = {
    #              starting    online      failing     offline
    E.ANSWERED: (S.ONLINE, S.ONLINE, S.ONLINE, S.ONLINE),
    E.UNCLEAR: (S.STARTING, S.FAILING, S.FAILING, S.OFFLINE),
    E.GAVE_UP: (S.OFFLINE, S.OFFLINE, S.OFFLINE, S.OFFLINE),
    E.RESTARTED: (S.STARTING, S.STARTING, S.STARTING, S.STARTING),
}
ROWS = [
    (state, event, after)
    for event, afters in TABLE.items()
    for state, after in zip(State, afters, strict=True)
]


def health(state: State = S.ONLINE, *, answerable: bool = True) -> Health:
    """A device in this state, by the shortest way."""
    found = Health(answerable=answerable)
    match state:
        case S.ONLINE:
            found.answered()
        case S.FAILING:
            found.answered()
            found.unclear(SILENCE, SPAN, 0.0)
        case S.OFFLINE:
            found.gave_up(0.0, 1.0)
    assert found.state is state
    return found


def happen(found: Health, event: Event) -> None:
    match event:
        case E.ANSWERED:
            found.answered()
        case E.UNCLEAR:
            found.unclear(SILENCE, SPAN, 0.0)
        case E.GAVE_UP:
            found.gave_up(0.0, 1.0)
        case E.RESTARTED:
            found.restart()


# The table


def test_the_table_has_each_pair_of_state_and_event_and_no_other() -> None:
    assert set(TRANSITIONS) == set(itertools.product(State, Event))
    assert set(TRANSITIONS.values()) == set(State)
    assert {(state, event): after for state, event, after in ROWS} == TRANSITIONS


@pytest.mark.parametrize(("state", "event", "after"), ROWS)
def test_each_event_leads_to_the_state_in_the_table(
    state: State, event: Event, after: State
) -> None:
    found = health(state)
    happen(found, event)
    assert found.state is after
    assert found.online == (after in (S.ONLINE, S.FAILING))


# Each method


def test_a_new_device_is_starting_and_needs_a_resync() -> None:
    found = Health()
    assert (found.state, found.online, found.needs_resync) == (S.STARTING, False, True)
    assert (found.outstanding, found.trouble, found.consecutive_failures) == (None, None, 0)


@pytest.mark.parametrize(
    ("state", "came"),
    [(S.STARTING, True), (S.OFFLINE, True), (S.FAILING, False), (S.ONLINE, False)],
)
def test_a_reply_tells_if_the_device_came_online(state: State, came: bool) -> None:
    assert health(state).answered() is came


def test_a_reply_ends_failures_resync_outstanding_request_trouble_and_pause() -> None:
    found = health(S.FAILING)
    found.gave_up(5.0, 1.0)
    found.answered()
    assert found.consecutive_failures == 0
    assert not found.needs_resync
    assert found.outstanding is None
    assert found.trouble is None
    assert found.probes.pause == 0.0
    assert found.outstanding_requests(-1.0) == 0


def test_an_unclear_end_counts_and_needs_a_resync() -> None:
    found = health()
    for count in (1, 2, 3):
        found.unclear(SILENCE, SPAN, float(count))
        assert found.consecutive_failures == count
    assert found.needs_resync
    assert found.outstanding == SPAN
    assert found.trouble is SILENCE


def test_an_unclear_probe_keeps_the_older_outstanding_request() -> None:
    found = health(S.FAILING)
    found.unclear(SILENCE, None, 1.0)
    assert found.outstanding == SPAN
    found.unclear(SILENCE, OTHER, 1.0)
    assert found.outstanding == OTHER


def test_too_slow_is_kept_over_no_reply_but_not_over_other_trouble() -> None:
    found, seen = health(), list[GatewayError | None]()
    slow, noise = Garbled("0.7 s", evidence=Evidence.SLOW), Garbled("noise")
    for error in (slow, SILENCE, noise, SILENCE):
        found.unclear(error, SPAN, 0.0)
        seen.append(found.trouble)
    assert seen == [slow, slow, noise, SILENCE]


@pytest.mark.parametrize("late", [0, 1])
def test_a_late_answer_of_any_device_of_the_line_ends_the_noise(late: int) -> None:
    """The damaged replies of one may have met the late reply of another."""
    line = link_device(station=1), link_device(station=2)
    found = line[0].health
    found.unclear(Garbled("spoiled", evidence=Evidence.NOISE), SPAN, 0.0)
    assert is_noisy(line[0], line, 1.0)
    assert not is_noisy(line[1], line, 1.0)
    older = Garbled("of older requests", evidence=Evidence.SLOW)
    line[late].health.unclear(older, SPAN, 1.0)
    assert not is_noisy(line[0], line, 2.0)
    found.unclear(Garbled("spoiled", evidence=Evidence.NOISE), SPAN, 61.0)
    assert not is_noisy(line[0], line, 60.9)
    assert is_noisy(line[0], line, 61.1)


@pytest.mark.parametrize(
    ("absent", "waited", "due"), [(False, 3.0, 3.0), (True, 0.5, 5.5), (True, 9.0, 39.0)]
)
def test_a_gateway_that_waits_in_vain_for_a_station_is_asked_for_it_seldom(
    absent: bool, waited: float, due: float
) -> None:
    """Meanwhile the other stations behind it had no replies."""
    found = health(S.OFFLINE)
    found.unanswered.add(SPAN, 0.0)
    found.replied_to_older(waited, absent=absent)
    assert found.probes.due == due
    assert found.probes.may_be_sent(due)
    assert not found.probes.may_be_sent(due - 0.1)
    found.gave_up(waited, 1.0)
    assert found.probes.due >= due


def test_a_restart_needs_a_resync_and_keeps_the_outstanding_request() -> None:
    found, lost = health(S.FAILING), LineDown("unplugged")
    found.restart(lost)
    assert found.trouble is lost
    assert found.consecutive_failures == 0
    assert found.needs_resync
    assert found.outstanding == SPAN
    found.restart()
    assert found.trouble is None


def test_a_restart_keeps_the_pause_of_an_offline_device() -> None:
    found = health(S.OFFLINE)
    found.restart()
    assert found.probes.pause == PAUSE_FIRST
    found.gave_up(0.0, 1.0)
    assert found.probes.pause == 2 * PAUSE_FIRST


def test_a_transaction_cut_off_by_the_loss_of_the_port_leaves_its_request_outstanding() -> None:
    found = health()
    found.left_outstanding(SPAN, 0.0)
    assert (found.state, found.needs_resync, found.outstanding) == (S.ONLINE, True, SPAN)
    found.left_outstanding(None, 0.0)
    assert found.outstanding == SPAN


@pytest.mark.parametrize("last", [True, False])
def test_the_last_late_reply_completes_the_resync_and_an_earlier_one_does_not(last: bool) -> None:
    found = health(S.FAILING)
    found.replied_late(0.7, 0.5, 1000.0, last=last)
    assert found.state is S.FAILING  # only a reply in time brings it online
    assert found.needs_resync is not last
    assert found.outstanding == (None if last else SPAN)
    assert found.outstanding_requests(-1.0) == (0 if last else 1)
    assert isinstance(found.trouble, Garbled)
    assert found.trouble.evidence is Evidence.SLOW
    assert str(found.trouble) == "it took 0.70 s, reply_timeout is 0.5 s"


def test_the_pause_between_probes_doubles_up_to_the_longest() -> None:
    found, pauses = health(), list[float]()
    for _ in range(9):
        found.gave_up(100.0, 1.1)
        pauses.append(found.probes.pause)
        assert found.probes.due == 100.0 + 1.1 * found.probes.pause
    assert pauses == [min(PAUSE_FIRST * 2**n, PROBE_PAUSE) for n in range(9)]


def test_probe_soon_allows_a_probe_one_second_after_the_last_one() -> None:
    found = health(S.OFFLINE)
    for _ in range(5):
        found.gave_up(100.0, 1.0)
    assert found.probes.due == 100.0 + PROBE_PAUSE
    found.probes.soon()
    assert found.probes.due == 100.0 + PAUSE_FIRST
    assert not found.probes.may_be_sent(100.0 + PAUSE_FIRST - 0.1)
    assert found.probes.may_be_sent(100.0 + PAUSE_FIRST)


def test_a_restart_keeps_if_the_device_was_heard() -> None:
    found, heard = health(), []
    for change in (found.answered, lambda: found.gave_up(0.0, 1.0), found.answered):
        change()
        found.restart()
        heard.append(found.heard)
    assert heard == [Heard.REPLIED, Heard.GAVE_UP, Heard.REPLIED]
    assert Health().heard is Heard.NEVER


def test_short_probes_are_counted_until_a_patient_one_a_reply_or_a_restart() -> None:
    found, counts = health(S.OFFLINE), []
    for short in (True, True, False, True):
        found.probes.sent(short=short)
        counts.append(found.probes.short)
    assert counts == [1, 2, 0, 1]
    found.restart()
    assert found.probes.short == 0
    found.probes.sent(short=True)
    found.answered()
    assert found.probes.short == 0


def test_probe_tokens_grow_by_two() -> None:
    found = health()
    first = found.next_probe_token()
    assert [found.next_probe_token(), found.next_probe_token()] == [first + 2, first + 4]


def test_requests_without_a_reply_are_counted_from_a_time_on() -> None:
    found = health()
    for at in (1.0, 2.0, 3.0):
        found.unclear(SILENCE, SPAN, at)
    assert [found.outstanding_requests(since) for since in (0.0, 1.0, 2.5, 3.0)] == [3, 2, 1, 0]
    for at in range(2 * MOST_UNANSWERED):
        found.unclear(SILENCE, SPAN, 10.0 + at)
    assert found.outstanding_requests(0.0) == MOST_UNANSWERED


def test_the_reason_of_bad_values_follows_the_trouble() -> None:
    found, reasons = health(), list[Reason]()
    for error in (SILENCE, Garbled("noise"), Unclear("other")):
        found.unclear(error, SPAN, 0.0)
        reasons.append(found.reason)
    assert reasons == [Reason.NO_REPLY, Reason.GARBLED, Reason.NO_REPLY]


@pytest.mark.parametrize("event", Event)
def test_a_device_that_cannot_answer_never_needs_a_resync(event: Event) -> None:
    found = health(S.STARTING, answerable=False)
    assert not found.needs_resync
    happen(found, event)
    found.left_outstanding(SPAN, 0.0)
    assert not found.needs_resync


def test_damaged_unsolicited_bytes_are_trouble_until_the_next_good_frame() -> None:
    found, damage = health(answerable=False), Garbled("noise")
    found.not_understood(damage)
    assert found.trouble is damage
    assert found.state is S.ONLINE
    found.understood()
    assert found.trouble is None


# The diagnosis


def test_no_trouble_has_no_diagnosis() -> None:
    assert diagnosis(None, "other causes") == NO_TROUBLE


def test_the_diagnosis_of_silence_adds_the_causes_that_the_protocol_knows() -> None:
    assert diagnosis(SILENCE, "Is it in RUN?").text.endswith(" Is it in RUN?")
    assert diagnosis(SILENCE, "").text.endswith(".")


def test_other_trouble_is_its_own_diagnosis() -> None:
    assert diagnosis(LineDown("unplugged"), "other causes") == ("other", "unplugged")


def test_a_station_of_which_all_replies_are_damaged_is_no_victim_of_noise() -> None:
    probes, now = link_device().health.probes, 0.0
    while probes.is_urgent(now) or not now:
        probes.replied_damaged(now)
        probes.grow(now, 1.0)
        now += 1.0
    assert now == HOPE_FOR
    assert probes.pause == PAUSE_ALIVE
    assert probes.is_alive(now)
    probes.grow(now, 1.0)
    assert probes.pause == PAUSE_FIRST
    probes.replied()
    probes.replied_damaged(now)
    assert probes.is_urgent(now)


@pytest.mark.parametrize("alone", [False, True])
def test_a_station_that_is_later_than_its_time_out_is_probed_less_and_less(alone: bool) -> None:
    """Each of its replies meets exchanges of others, if there are others."""
    probes, now, pauses = link_device().health.probes, 0.0, []
    for _ in range(30):
        probes.sent(short=False)
        probes.grow(now, 1.0)
        probes.spoke(now + 0.5, 1.0, alone=alone)
        pauses.append(probes.due - now)
        now = probes.due + 1.0
    assert pauses[0] <= PAUSE_FIRST
    assert max(pauses) == pytest.approx(0.5 if alone else 0.5 + PAUSE_LATE)
    probes.sent(short=False)
    probes.replied()
    probes.sent(short=True)
    probes.grow(now, 1.0)
    probes.spoke(now, 1.0)
    assert probes.due == now
