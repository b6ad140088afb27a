"""The second request of a resync: its reply has the form that was requested longest ago."""

from gateway.engine.device.device import Device as EngineDevice
from gateway.engine.device.probe_pace import LATE_FOR, LATE_MOST
from gateway.engine.device.second_requests import (
    MOST_SILENT,
    is_like_a_second,
    leave_second,
    second_token,
)
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.driver import Span
from gateway.protocols.modbus import ModbusRtu
from tests.sim.bench import WIRE
from tests.sim.plant import made_device, make_tag

ROW, SEVERAL, SINGLE = (0, 1, 2, 3), (0, 1, 2, 3, 100), (0, 100, 200)


def made(*numbers: int) -> EngineDevice:
    driver = ModbusRtu(station=1)
    tags = [make_tag(f"holding:{n}", driver, device="plc", type="uint16") for n in numbers]
    return made_device("plc", driver, WIRE, driver.timing, tags)


def form(device: EngineDevice, outstanding: Span | None, token: int) -> object:
    assert device.shapes is not None
    return device.shapes.of_resync(outstanding, token, device.probe_spans)


def chosen(device: EngineDevice, token: int, now: float) -> int:
    found, quiet = second_token(device, None, token, now)
    assert not quiet
    return found


def test_it_has_the_form_that_was_requested_longest_ago() -> None:
    plc, forms = made(*ROW), []
    assert plc.shapes is not None
    for now in range(8):
        token = plc.health.next_probe_token()
        plc.shapes.probed(None, token, plc.probe_spans, now)
        forms.append(form(plc, None, chosen(plc, token + 1, now)))
        assert forms[-1] != form(plc, None, token)
    assert len(set(forms)) == 2  # two registers and four: first requests read one and three


def test_it_has_not_the_form_of_what_a_program_reads() -> None:
    plc = made(*ROW)
    assert plc.shapes is not None
    for size in (1, 2, 3):
        plc.shapes.also_sent(plc.shapes.of(Span("holding", 700, size)), 5.0)
    token = chosen(plc, plc.health.next_probe_token() + 1, 6.0)
    assert form(plc, None, token) == plc.shapes.of(Span("holding", 700, 4))


def test_a_device_with_single_registers_gets_the_first_choice() -> None:
    plc, one = made(*SINGLE), Span("holding", 100, 1)
    assert [second_token(plc, one, token, 1.0)[0] for token in (3, 5, 7)] == [3, 5, 7]


def test_a_device_that_is_silent_about_it_gets_the_first_choice() -> None:
    plc = made(*SEVERAL)
    plc.note_resync(None, 3, 0.5)
    second = chosen(plc, 3, 1.0)
    assert second != 3
    for _ in range(MOST_SILENT):
        leave_second(plc, None, second, 1.0)
    assert chosen(plc, 3, 2.0) == 3


def test_a_device_that_is_late_is_not_taken_for_a_silent_one() -> None:
    plc = made(*SEVERAL)
    plc.health.probes.replied_late(0.9)
    for _ in range(9):
        leave_second(plc, None, 5, 1.0)
    plc.note_resync(None, 3, 0.5)
    assert chosen(plc, 3, 2.0) != 3


def test_a_later_resync_of_its_form_proves_nothing_until_one_is_answered() -> None:
    plc = made(*ROW)
    leave_second(plc, None, 7, 1.0)
    alike = [token for token in range(8, 40, 2) if is_like_a_second(plc, None, token)]
    assert alike
    assert any(not is_like_a_second(plc, None, token) for token in range(8, 40, 2))
    plc.health.answered(resynced=True)
    assert not any(is_like_a_second(plc, None, token) for token in alike)


def late(by: float) -> EngineDevice:
    """Returns a device with one unanswered request, at 0, and a reply `by` seconds later."""
    plc = made(*ROW)
    plc.health.left_outstanding(None, 0.0)
    plc.health.spoke(by, plc.longest_reply)
    assert plc.shapes is not None
    for size in (1, 2, 3, 4):
        shape = plc.shapes.of(Span("holding", 0, size))
        plc.shapes.also_sent(shape, by + size / 10)
        plc.health.unanswered.seconds.append(shape)
    return plc


def test_a_form_that_a_late_station_may_still_answer_is_not_asked_for() -> None:
    plc = late(0.5)
    first = 0.5 + 0.1  # when the form of one register was requested
    assert second_token(plc, None, 3, first + 2 * 0.5 - 0.01)[1] == 2 * 0.5
    token = chosen(plc, 3, first + 2 * 0.5 + 0.01)
    assert form(plc, None, token) == ModbusRtu(station=1).reply_shape(Span("holding", 0, 1))


def test_a_form_that_only_first_requests_had_is_asked_for() -> None:
    plc = late(0.5)
    plc.health.unanswered.seconds.clear()
    assert chosen(plc, 3, 1.0)


def test_another_master_makes_no_station_late_for_ever() -> None:
    plc = late(30.0)
    assert second_token(plc, None, 3, 30.1 + 2 * LATE_MOST - 0.01)[1] == 2 * LATE_MOST
    assert chosen(plc, 3, 30.1 + 2 * LATE_MOST + 0.01)


def test_a_minute_without_a_late_reply_ends_it() -> None:
    plc = late(0.5)
    now = 0.5 + LATE_FOR
    assert plc.shapes is not None
    for size in (1, 2, 3, 4):
        plc.shapes.also_sent(plc.shapes.of(Span("holding", 0, size)), now)
    assert chosen(plc, 3, now)


def test_where_no_other_form_is_left_the_line_is_quiet_once_not_for_ever() -> None:
    """The gateway stood still: the quiet before the first choice was asked for without end."""
    plc, one = made(*SINGLE), Span("holding", 100, 1)
    plc.health.left_outstanding(None, 0.0)
    plc.health.spoke(0.5, plc.longest_reply)
    plc.note_resync(one, 3, 1.0)
    leave_second(plc, one, 3, 1.0)
    lateness = plc.health.probes.lateness(1.0)
    assert lateness > 0
    assert second_token(plc, one, 3, 1.0) == (3, lateness)
    assert second_token(plc, one, 3, 1.01 + lateness) == (3, 0.0)


def test_a_loopback_without_a_reply_is_not_remembered() -> None:
    driver = ComputerLink(station=1)
    tags = [make_tag(f"D{n}", driver, device="plc", type="uint16") for n in (0, 100)]
    plc = made_device("plc", driver, WIRE, driver.timing, tags)
    assert form(plc, None, 3) is None
    leave_second(plc, None, 3, 1.0)
    assert not plc.health.unanswered.seconds
