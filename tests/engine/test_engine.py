"""The engine as one table: state, job and result lead to a state, effects and the next job.

Columns: the device's state; the job in flight; its result; the state after it; the effects without
log events, "-" for none; the next job. After "lost" the line closes instead.

States: "failing" is a device whose last transaction failed; before polls, writes and commands its
late reply has arrived, so it needs no resync. `retries` is 1: the second failure is the last.

Jobs: "PollAgain" is the last retry, of a longer span, "PollReadBefore" a block that was read well
before. A settling line is named by the job before it: "Last..." if that was the last failure,
"NotSent" if nothing was sent, "Ambiguous" if the reply to a probe may answer an older request.
"...Verify" is the same job for a tag with `verify`, "ConfirmBoth" for one with `verify` and
`repeat`.

Results: "any-refusal" and "any-unclear" are several results with one row. "to-all" had no reply by
design, "held" is read back as written, "differs" is not, "not-sent" failed before the first byte.
"""

from collections.abc import Callable, Iterator
from math import inf
from typing import get_args

import pytest

from gateway.engine.device.ages import polled_blocks, worst_ages
from gateway.engine.device.health import State
from gateway.engine.effects import Effect
from gateway.engine.jobs.jobs import (
    Answer,
    HeldTogether,
    Identify,
    Idle,
    Poll,
    Probe,
    Result,
    Resynced,
    Sent,
    Settle,
    Settled,
    Traffic,
    Transacted,
)
from gateway.engine.jobs.requests import MOST_WAITING, Write
from gateway.engine.results.unsolicited import REPLY_WITHIN
from gateway.errors import (
    BadValue,
    Busy,
    Garbled,
    LineDown,
    Offline,
    Refusal,
    Refused,
    Unsteady,
)
from gateway.protocols.computer_link.codec import Ack
from tests.engine.rig import (
    LOST,
    REPLIED,
    SILENCE,
    Rig,
    broadcast_device,
    kinds,
    link_device,
    tcp_device,
    weighing_machine,
)
from tests.sim.bench import WIRE
from tests.vectors import vectors

BY_ID = {v.id: v for v in vectors("noproto-k120s")}
NOISE = Garbled("noise")
ADDRESS, DAMAGED, BUSY, OTHER = (
    Refused(f"refused: {refusal}", code="06", refusal=refusal) for refusal in Refusal
)
UNITS = [1, 2, 3, 4, 5, 6]
HELD, OLD = [7], [0]  # units that are read back: as written, as before
NOTHING_SENT = Traffic()
TOLD_TO_ALL = Traffic(sent=17)

# By name: a result, and the traffic where it is not the usual.
RESULTS: dict[str, tuple[Result, Traffic | None]] = {
    "units": (UNITS, None),
    "address": (ADDRESS, REPLIED),
    "damaged": (DAMAGED, REPLIED),
    "busy": (BUSY, REPLIED),
    "refused": (OTHER, REPLIED),
    "unsteady": (Unsteady("differ"), REPLIED),
    "silence": (SILENCE, None),
    "noise": (NOISE, None),
    "not-sent": (SILENCE, NOTHING_SENT),
    "lost": (LOST, None),
    "resynced": (Resynced(1), None),
    "ambiguous": (Resynced(0), None),
    "sent": (Sent(), None),
    "to-all": (Sent(acknowledged=False), TOLD_TO_ALL),
    "held": (Sent(held=HELD), None),
    "differs": (Sent(held=OLD), None),
    "refused-back": (Sent(refused_back=OTHER), None),
    "obeyed": ("acknowledged", None),
    "obeyed-by-all": ("sent", TOLD_TO_ALL),
    "bad-value": (BadValue("no argument"), NOTHING_SENT),
    "quiet": (Settled(None), None),
    "late": (Settled(0.1), None),
    "never-quiet": (Settled(None, quiet=False), None),
    "held-both": (HeldTogether([HELD, HELD]), None),
    "held-first": (HeldTogether([HELD, ADDRESS]), None),
}
REFUSALS = ["address", "damaged", "busy", "refused"]
UNCLEAR = ["silence", "noise"]
GROUPS = {"any-refusal": REFUSALS, "any-unclear": UNCLEAR}
FAILURES = [*REFUSALS, *UNCLEAR, "lost"]
# By job: every result that it can have.
RESULTS_OF = {
    "Poll": ["units", "unsteady", *FAILURES],
    "PollAgain": ["units", "unsteady", *FAILURES],
    "PollReadBefore": ["units", "unsteady", *FAILURES],
    "Probe": ["resynced", "ambiguous", *FAILURES],
    "ProbeAgain": ["resynced", "ambiguous", *FAILURES],
    "Write": ["sent", "to-all", *FAILURES, "not-sent"],
    "WriteVerified": ["held", "differs", "refused-back", "to-all", *FAILURES, "not-sent"],
    "WriteTogether": ["sent", *FAILURES, "not-sent"],
    "ReadBack": ["held-both", "held-first", *UNCLEAR, "lost"],
    "Command": ["obeyed", "bad-value", *FAILURES, "not-sent"],
    "CommandToAll": ["obeyed-by-all"],
    "Confirm": ["sent", *FAILURES],
    "ConfirmVerify": ["held", "differs", *FAILURES],
    "ConfirmBoth": ["held", "differs", *FAILURES],
    "Repeat": ["sent", "to-all", *FAILURES],
    "Settle": ["quiet", "late"],
    "Settle/Ambiguous": ["quiet", "late", "never-quiet"],
}


Setup = Callable[[Rig], Transacted]


def first(rig: Rig) -> Transacted:
    """The first job of the state: a poll or a probe."""
    return rig.transacted()


def poll_again(rig: Rig) -> Transacted:
    """The last retry of a refused poll."""
    rig.conclude(rig.transacted(), DAMAGED, REPLIED)
    return rig.transacted()


def poll_read_before(rig: Rig) -> Transacted:
    rig.conclude(rig.transacted(), UNITS)
    return rig.transacted()


def after_failed_poll(rig: Rig) -> Transacted:
    rig.fail(rig.transacted())
    return rig.transacted()


def ambiguous(before: Setup) -> Setup:
    """The quiet after a reply that may answer an older request."""

    def setup(rig: Rig) -> Transacted:
        rig.conclude(before(rig), Resynced(0))
        return rig.transacted()

    return setup


def probe_again(before: Setup) -> Setup:
    def setup(rig: Rig) -> Transacted:
        rig.conclude(ambiguous(before)(rig), Settled(None))
        return rig.transacted()

    return setup


def write(text: str) -> Setup:
    def setup(rig: Rig) -> Transacted:
        rig.write(text)
        return rig.transacted()

    return setup


def write_together(rig: Rig) -> Transacted:
    rig.write("D0")
    rig.write("D1")
    return rig.transacted()


def read_back(rig: Rig) -> Transacted:
    rig.conclude(write_together(rig), ADDRESS)
    return rig.transacted()


def command(name: str = "stop") -> Setup:
    def setup(rig: Rig) -> Transacted:
        rig.command(name)
        return rig.transacted()

    return setup


def settle(before: Setup, traffic: Traffic | None = None) -> Setup:
    """The quiet after an unclear end."""

    def setup(rig: Rig) -> Transacted:
        rig.conclude(before(rig), SILENCE, traffic)
        return rig.transacted()

    return setup


def after_failed_write(text: str) -> Setup:
    def setup(rig: Rig) -> Transacted:
        rig.fail(write(text)(rig))
        return rig.transacted()

    return setup


def after_late_reply(then: Setup) -> Setup:
    """The last failure takes the device offline, but its late reply ends the need of a resync."""

    def setup(rig: Rig) -> Transacted:
        rig.fail(rig.transacted(), late=0.1)
        return then(rig)

    return setup


def repeat(rig: Rig) -> Transacted:
    rig.conclude(after_failed_write("D3")(rig), Sent())
    return rig.transacted()


S = State
# The situations by state and job: the state to begin with, and what happens then.
SITUATIONS: dict[str, tuple[State, Setup]] = {
    "starting Probe": (S.STARTING, first),
    "starting Settle/Probe": (S.STARTING, settle(first)),
    "online Poll": (S.ONLINE, first),
    "online PollAgain": (S.ONLINE, poll_again),
    "online PollReadBefore": (S.ONLINE, poll_read_before),
    "online Write": (S.ONLINE, write("D0")),
    "online WriteVerified": (S.ONLINE, write("D2")),
    "online WriteTogether": (S.ONLINE, write_together),
    "online ReadBack": (S.ONLINE, read_back),
    "online Command": (S.ONLINE, command()),
    "online CommandToAll": (S.ONLINE, command("global")),
    "failing Poll": (S.FAILING, first),
    "failing Write": (S.FAILING, write("D0")),
    "failing WriteVerified": (S.FAILING, write("D2")),
    "failing WriteTogether": (S.FAILING, write_together),
    "failing Command": (S.FAILING, command()),
    "failing CommandToAll": (S.FAILING, command("global")),
    "failing Probe": (S.ONLINE, after_failed_poll),
    "failing Settle/Ambiguous": (S.ONLINE, ambiguous(after_failed_poll)),
    "failing ProbeAgain": (S.ONLINE, probe_again(after_failed_poll)),
    "failing Confirm": (S.ONLINE, after_failed_write("D3")),
    "failing ConfirmVerify": (S.ONLINE, after_failed_write("D2")),
    "failing ConfirmBoth": (S.ONLINE, after_failed_write("D4")),
    "failing Repeat": (S.ONLINE, repeat),
    "failing Settle/Poll": (S.ONLINE, settle(first)),
    "failing Settle/Write": (S.ONLINE, settle(write("D0"))),
    "failing Settle/WriteVerified": (S.ONLINE, settle(write("D2"))),
    "failing Settle/WriteTogether": (S.ONLINE, settle(write_together)),
    "failing Settle/ReadBack": (S.ONLINE, settle(read_back)),
    "failing Settle/Command": (S.ONLINE, settle(command())),
    "failing Settle/NotSent": (S.ONLINE, settle(write("D2"), NOTHING_SENT)),
    "failing Settle/LastPoll": (S.FAILING, settle(first)),
    "failing Settle/LastWrite": (S.FAILING, settle(write("D0"))),
    "failing Settle/LastVerified": (S.FAILING, settle(write("D2"))),
    "failing Settle/LastTogether": (S.FAILING, settle(write_together)),
    "failing Settle/LastCommand": (S.FAILING, settle(command())),
    "failing Settle/LastProbe": (S.ONLINE, settle(after_failed_poll)),
    "failing Settle/Confirm": (S.ONLINE, settle(after_failed_write("D3"))),
    "failing Settle/Repeat": (S.ONLINE, settle(repeat)),
    "offline Probe": (S.OFFLINE, first),
    "offline Settle/Probe": (S.OFFLINE, settle(first)),
    "offline Settle/Ambiguous": (S.OFFLINE, ambiguous(first)),
    "offline ProbeAgain": (S.OFFLINE, probe_again(first)),
    "offline Write": (S.FAILING, after_late_reply(write("D0"))),
    "offline WriteVerified": (S.FAILING, after_late_reply(write("D2"))),
    "offline WriteTogether": (S.FAILING, after_late_reply(write_together)),
    "offline Command": (S.FAILING, after_late_reply(command())),
    "offline CommandToAll": (S.FAILING, after_late_reply(command("global"))),
    "offline Confirm": (S.FAILING, after_failed_write("D3")),
    "offline ConfirmVerify": (S.FAILING, after_failed_write("D2")),
    "offline ConfirmBoth": (S.FAILING, after_failed_write("D4")),
    "offline Repeat": (S.FAILING, repeat),
    "offline Settle/Confirm": (S.FAILING, settle(after_failed_write("D3"))),
    "offline Settle/Repeat": (S.FAILING, settle(repeat)),
}


TABLE = """
state    job                   result        after     effects                              next

starting Probe                 resynced      online    online                               Poll
starting Probe                 ambiguous     online    online                               Poll
starting Probe                 any-refusal   online    online                               Poll
starting Probe                 any-unclear   starting  -                                    Settle
starting Probe                 lost          starting  -                                    -
starting Settle/Probe          quiet         offline   bad:no-reply+offline                 Idle
starting Settle/Probe          late          offline   bad:garbled+offline                  Idle

online   Poll                  units         online    good                                 Idle
online   Poll                  unsteady      online    -                                    Poll
online   Poll                  address       online    -                                    Poll
online   Poll                  damaged       online    -                                    Poll
online   Poll                  busy          online    -                                    Idle
online   Poll                  refused       online    -                                    Idle
online   Poll                  any-unclear   failing   -                                    Settle
online   Poll                  lost          online    -                                    -
online   PollAgain             units         online    good                                 Idle
online   PollAgain             unsteady      online    bad:garbled                          Idle
online   PollAgain             address       online    -                                    Poll
online   PollAgain             damaged       online    bad:refused                          Idle
online   PollAgain             busy          online    bad:refused                          Idle
online   PollAgain             refused       online    -                                    Poll
online   PollAgain             any-unclear   failing   -                                    Settle
online   PollAgain             lost          online    -                                    -
online   PollReadBefore        units         online    good                                 Idle
online   PollReadBefore        unsteady      online    -                                    Poll
online   PollReadBefore        address       online    -                                    Poll
online   PollReadBefore        damaged       online    -                                    Poll
online   PollReadBefore        busy          online    -                                    Idle
online   PollReadBefore        refused       online    -                                    Idle
online   PollReadBefore        any-unclear   failing   -                                    Settle
online   PollReadBefore        lost          online    -                                    -
online   Write                 sent          online    written                              Poll
online   Write                 to-all        online    pause+sent                           Poll
online   Write                 any-refusal   online    Refused                              Poll
online   Write                 any-unclear   failing   -                                    Settle
online   Write                 lost          online    Unclear                              -
online   Write                 not-sent      failing   -                                    Settle
online   WriteVerified         held          online    verified                             Poll
online   WriteVerified         differs       online    Differs                              Poll
online   WriteVerified         refused-back  online    Differs                              Poll
online   WriteVerified         to-all        online    pause+sent                           Poll
online   WriteVerified         any-refusal   online    Refused                              Poll
online   WriteVerified         any-unclear   failing   -                                    Settle
online   WriteVerified         lost          online    Unclear                              -
online   WriteVerified         not-sent      failing   -                                    Settle
online   WriteTogether         sent          online    written+written                      Poll
online   WriteTogether         any-refusal   online    -                                    ReadBack
online   WriteTogether         any-unclear   failing   -                                    Settle
online   WriteTogether         lost          online    Unclear+Unclear                      -
online   WriteTogether         not-sent      failing   -                                    Settle
online   ReadBack              held-both     online    verified+verified                    Poll
online   ReadBack              held-first    online    verified+Refused                     Poll
online   ReadBack              any-unclear   failing   -                                    Settle
online   ReadBack              lost          online    Unclear+Unclear                      -
online   Command               obeyed        online    obeyed                               Poll
online   CommandToAll          obeyed-by-all online    pause+obeyed                         Poll
online   Command               bad-value     online    BadValue                             Poll
online   Command               any-refusal   online    Refused                              Poll
online   Command               any-unclear   failing   -                                    Settle
online   Command               lost          online    Unclear                              -
online   Command               not-sent      failing   -                                    Settle

failing  Poll                  units         online    good                                 Idle
failing  Poll                  unsteady      online    bad:garbled                          Idle
failing  Poll                  address       online    -                                    Poll
failing  Poll                  damaged       online    bad:refused                          Idle
failing  Poll                  busy          online    bad:refused                          Idle
failing  Poll                  refused       online    -                                    Poll
failing  Poll                  any-unclear   failing   -                                    Settle
failing  Poll                  lost          failing   -                                    -
failing  Write                 sent          online    written                              Poll
failing  Write                 to-all        failing   pause+sent                           Poll
failing  Write                 any-refusal   online    Refused                              Poll
failing  Write                 any-unclear   failing   -                                    Settle
failing  Write                 lost          failing   Unclear                              -
failing  Write                 not-sent      failing   -                                    Settle
failing  WriteVerified         held          online    verified                             Poll
failing  WriteVerified         differs       online    Differs                              Poll
failing  WriteVerified         refused-back  online    Differs                              Poll
failing  WriteVerified         to-all        failing   pause+sent                           Poll
failing  WriteVerified         any-refusal   online    Refused                              Poll
failing  WriteVerified         any-unclear   failing   -                                    Settle
failing  WriteVerified         lost          failing   Unclear                              -
failing  WriteVerified         not-sent      failing   -                                    Settle
failing  WriteTogether         sent          online    written+written                      Poll
failing  WriteTogether         any-refusal   online    -                                    ReadBack
failing  WriteTogether         any-unclear   failing   -                                    Settle
failing  WriteTogether         lost          failing   Unclear+Unclear                      -
failing  WriteTogether         not-sent      failing   -                                    Settle
failing  Command               obeyed        online    obeyed                               Poll
failing  CommandToAll          obeyed-by-all failing   pause+obeyed                         Poll
failing  Command               bad-value     failing   BadValue                             Poll
failing  Command               any-refusal   online    Refused                              Poll
failing  Command               any-unclear   failing   -                                    Settle
failing  Command               lost          failing   Unclear                              -
failing  Command               not-sent      failing   -                                    Settle
failing  Probe                 resynced      online    -                                    Poll
failing  Probe                 ambiguous     failing   -                                    Settle
failing  Probe                 any-refusal   failing   -                                    Settle
failing  Probe                 any-unclear   failing   -                                    Settle
failing  Probe                 lost          failing   -                                    -
failing  Settle/Ambiguous      quiet         failing   -                                    Probe
failing  Settle/Ambiguous      late          failing   -                                    Probe
failing  Settle/Ambiguous      never-quiet   failing   -                                    Settle
failing  ProbeAgain            resynced      online    -                                    Poll
failing  ProbeAgain            ambiguous     online    -                                    Poll
failing  ProbeAgain            any-refusal   online    -                                    Poll
failing  ProbeAgain            any-unclear   failing   -                                    Settle
failing  ProbeAgain            lost          failing   -                                    -
failing  Confirm               sent          failing   -                                    Repeat
failing  Confirm               any-refusal   online    NoReply                              Poll
failing  Confirm               any-unclear   failing   -                                    Settle
failing  Confirm               lost          failing   Unclear                              -
failing  ConfirmVerify         held          online    verified                             Poll
failing  ConfirmVerify         differs       failing   NoReply                              Probe
failing  ConfirmVerify         any-refusal   online    NoReply                              Poll
failing  ConfirmVerify         any-unclear   failing   -                                    Settle
failing  ConfirmVerify         lost          failing   Unclear                              -
failing  ConfirmBoth           held          online    verified                             Poll
failing  ConfirmBoth           differs       failing   -                                    Repeat
failing  ConfirmBoth           any-refusal   online    NoReply                              Poll
failing  ConfirmBoth           any-unclear   failing   -                                    Settle
failing  ConfirmBoth           lost          failing   Unclear                              -
failing  Repeat                sent          online    written                              Poll
failing  Repeat                to-all        failing   pause+sent                           Probe
failing  Repeat                any-refusal   online    NoReply                              Poll
failing  Repeat                any-unclear   failing   -                                    Settle
failing  Repeat                lost          failing   Unclear                              -
failing  Settle/Poll           quiet         failing   -                                    Probe
failing  Settle/Poll           late          failing   -                                    Poll
failing  Settle/Write          quiet         failing   NoReply                              Probe
failing  Settle/Write          late          failing   NoReply                              Poll
failing  Settle/WriteVerified  quiet         failing   -                                    Confirm
failing  Settle/WriteVerified  late          failing   -                                    Confirm
failing  Settle/WriteTogether  quiet         failing   NoReply+NoReply                      Probe
failing  Settle/WriteTogether  late          failing   NoReply+NoReply                      Poll
failing  Settle/ReadBack       quiet         failing   Unclear+Unclear                      Probe
failing  Settle/ReadBack       late          failing   Unclear+Unclear                      Poll
failing  Settle/Command        quiet         failing   NoReply                              Probe
failing  Settle/Command        late          failing   NoReply                              Poll
failing  Settle/NotSent        quiet         failing   Busy                                 Probe
failing  Settle/NotSent        late          failing   Busy                                 Poll
failing  Settle/LastPoll       quiet         offline   bad:garbled+offline                  Idle
failing  Settle/LastPoll       late          offline   bad:garbled+offline                  Idle
failing  Settle/LastWrite      quiet         offline   bad:garbled+offline+NoReply          Idle
failing  Settle/LastWrite      late          offline   bad:garbled+offline+NoReply          Idle
failing  Settle/LastVerified   quiet         offline   bad:garbled+offline                  Confirm
failing  Settle/LastVerified   late          offline   bad:garbled+offline                  Confirm
failing  Settle/LastTogether   quiet         offline   bad:garbled+offline+NoReply+NoReply  Idle
failing  Settle/LastTogether   late          offline   bad:garbled+offline+NoReply+NoReply  Idle
failing  Settle/LastCommand    quiet         offline   bad:garbled+offline+NoReply          Idle
failing  Settle/LastCommand    late          offline   bad:garbled+offline+NoReply          Idle
failing  Settle/LastProbe      quiet         offline   bad:no-reply+offline                 Idle
failing  Settle/LastProbe      late          offline   bad:garbled+offline                  Idle
failing  Settle/Confirm        quiet         offline   bad:no-reply+offline+NoReply         Idle
failing  Settle/Confirm        late          offline   bad:garbled+offline+NoReply          Idle
failing  Settle/Repeat         quiet         offline   bad:no-reply+offline+NoReply         Idle
failing  Settle/Repeat         late          offline   bad:garbled+offline+NoReply          Idle

offline  Probe                 resynced      online    online                               Poll
offline  Probe                 ambiguous     offline   -                                    Settle
offline  Probe                 any-refusal   offline   -                                    Settle
offline  Probe                 any-unclear   offline   -                                    Settle
offline  Probe                 lost          offline   -                                    -
offline  Settle/Probe          quiet         offline   bad:no-reply                         Idle
offline  Settle/Probe          late          offline   bad:garbled                          Idle
offline  Settle/Ambiguous      quiet         offline   -                                    Probe
offline  Settle/Ambiguous      late          offline   -                                    Probe
offline  Settle/Ambiguous      never-quiet   offline   -                                    Settle
offline  ProbeAgain            resynced      online    online                               Poll
offline  ProbeAgain            ambiguous     online    online                               Poll
offline  ProbeAgain            any-refusal   online    online                               Poll
offline  ProbeAgain            any-unclear   offline   -                                    Settle
offline  ProbeAgain            lost          offline   -                                    -
offline  Write                 sent          online    online+written                       Poll
offline  Write                 to-all        offline   pause+sent                           Idle
offline  Write                 any-refusal   online    online+Refused                       Poll
offline  Write                 any-unclear   offline   -                                    Settle
offline  Write                 lost          offline   Unclear                              -
offline  Write                 not-sent      offline   -                                    Settle
offline  WriteVerified         held          online    online+verified                      Poll
offline  WriteVerified         differs       online    online+Differs                       Poll
offline  WriteVerified         refused-back  online    online+Differs                       Poll
offline  WriteVerified         to-all        offline   pause+sent                           Idle
offline  WriteVerified         any-refusal   online    online+Refused                       Poll
offline  WriteVerified         any-unclear   offline   -                                    Settle
offline  WriteVerified         lost          offline   Unclear                              -
offline  WriteVerified         not-sent      offline   -                                    Settle
offline  WriteTogether         sent          online    online+written+written               Poll
offline  WriteTogether         any-refusal   online    online                               ReadBack
offline  WriteTogether         any-unclear   offline   -                                    Settle
offline  WriteTogether         lost          offline   Unclear+Unclear                      -
offline  WriteTogether         not-sent      offline   -                                    Settle
offline  Command               obeyed        online    online+obeyed                        Poll
offline  CommandToAll          obeyed-by-all offline   pause+obeyed                         Idle
offline  Command               bad-value     offline   BadValue                             Idle
offline  Command               any-refusal   online    online+Refused                       Poll
offline  Command               any-unclear   offline   -                                    Settle
offline  Command               lost          offline   Unclear                              -
offline  Command               not-sent      offline   -                                    Settle
offline  Confirm               sent          offline   -                                    Repeat
offline  Confirm               any-refusal   online    online+NoReply                       Poll
offline  Confirm               any-unclear   offline   -                                    Settle
offline  Confirm               lost          offline   Unclear                              -
offline  ConfirmVerify         held          online    online+verified                      Poll
offline  ConfirmVerify         differs       offline   NoReply                              Idle
offline  ConfirmVerify         any-refusal   online    online+NoReply                       Poll
offline  ConfirmVerify         any-unclear   offline   -                                    Settle
offline  ConfirmVerify         lost          offline   Unclear                              -
offline  ConfirmBoth           held          online    online+verified                      Poll
offline  ConfirmBoth           differs       offline   -                                    Repeat
offline  ConfirmBoth           any-refusal   online    online+NoReply                       Poll
offline  ConfirmBoth           any-unclear   offline   -                                    Settle
offline  ConfirmBoth           lost          offline   Unclear                              -
offline  Repeat                sent          online    online+written                       Poll
offline  Repeat                to-all        offline   pause+sent                           Idle
offline  Repeat                any-refusal   online    online+NoReply                       Poll
offline  Repeat                any-unclear   offline   -                                    Settle
offline  Repeat                lost          offline   Unclear                              -
offline  Settle/Confirm        quiet         offline   bad:garbled+NoReply                  Idle
offline  Settle/Confirm        late          offline   bad:garbled+NoReply                  Idle
offline  Settle/Repeat         quiet         offline   bad:garbled+NoReply                  Idle
offline  Settle/Repeat         late          offline   bad:garbled+NoReply                  Idle
"""


def rows() -> Iterator[tuple[str, str, str, str, str, str]]:
    for line in TABLE.splitlines()[2:]:
        if line:
            state, job, results, after, effects, following = line.split()
            for result in GROUPS.get(results, [results]):
                yield state, job, result, after, effects, following


def results_of(job: str) -> list[str]:
    return RESULTS_OF.get(job) or RESULTS_OF[job.split("/")[0]]


def test_the_table_has_each_result_of_each_job_once() -> None:
    wanted = [
        (*situation.split(), result)
        for situation in SITUATIONS
        for result in results_of(situation.split()[1])
    ]
    assert sorted(row[:3] for row in rows()) == sorted(wanted)


def test_the_situations_have_each_state_and_each_type_of_job() -> None:
    jobs = set[type]()
    for begin, setup in SITUATIONS.values():
        rig = Rig()
        rig.bring(begin)
        jobs.add(type(setup(rig)))
    # The device of an `Answer` is another: see below. One with an identity is in test_identities.
    assert jobs == set(get_args(Transacted)) - {Answer, Identify}
    assert {situation.split()[0] for situation in SITUATIONS} == set(State)


@pytest.mark.parametrize(
    ("state", "job", "result", "after", "effects", "following"),
    [pytest.param(*row, id="-".join(row[:3])) for row in rows()],
)
def test_the_result_of_a_job_leads_to_the_state_effects_and_job_in_the_table(
    state: str, job: str, result: str, after: str, effects: str, following: str
) -> None:
    begin, setup = SITUATIONS[f"{state} {job}"]
    rig = Rig()
    rig.bring(begin)
    made = setup(rig)
    assert rig.device.state == state
    submitted = len(rig.outcomes)
    given, traffic = RESULTS[result]
    found = rig.conclude(made, given, traffic)
    assert (rig.device.state, kinds(found)) == (after, effects)
    if given is not LOST:
        assert type(rig.next()).__name__ == following
        return
    assert following == "-"
    rig.note(rig.engine.lost(LOST, rig.now, rig.time))  # no request ends twice
    assert rig.device.state is State.STARTING
    assert rig.device.health.needs_resync
    assert len(rig.outcomes) >= submitted


# Devices that send unsolicited frames, and devices that never reply

WEIGHED, ANSWER = BY_ID["noproto-k120s-001"].frame, BY_ID["noproto-k120s-002"].frame


@pytest.mark.parametrize("result", [None, NOISE, LOST], ids=["sent", "noise", "lost"])
def test_the_reply_to_an_unsolicited_frame_has_no_effect_on_its_device(
    result: Result,
) -> None:
    rig = Rig(weighing_machine())
    assert rig.next() == Idle(inf)
    rig.now = rig.engine.deadline  # the silence after the port was opened
    rig.note(rig.engine.expire(rig.now, rig.time))
    rig.now = 1.0
    effects = rig.note(rig.engine.received(WEIGHED, rig.now, rig.time))
    assert kinds(effects) == "online+good"
    job = rig.next()
    assert isinstance(job, Answer)
    assert (job.device, job.until) == (rig.device, rig.now + REPLY_WITHIN)
    assert rig.device.driver.codec().encode(job.frame) == ANSWER
    assert kinds(rig.conclude(job, result)) == "-"
    assert rig.device.state is State.ONLINE
    assert rig.next() == Idle(inf)


BROADCAST = """
state    result        after     effects
starting to-all        starting  pause+sent
starting sent          online    online+written
starting refused       online    online+Refused
starting silence       starting  NoReply
online   to-all        online    pause+sent
online   sent          online    written
online   refused       online    Refused
online   silence       failing   NoReply
failing  to-all        failing   pause+sent
failing  sent          online    written
failing  refused       online    Refused
failing  silence       starting  offline+NoReply
"""


@pytest.mark.parametrize("row", BROADCAST.split("\n")[2:-1])
def test_a_broadcast_device_is_written_in_each_state_and_never_probed(row: str) -> None:
    """Without a resync, and it is never offline: no request could bring it back."""
    state, result, after, effects = row.split()
    rig = Rig(broadcast_device())
    for earlier in {"starting": (), "online": ("sent",), "failing": ("sent", "silence")}[state]:
        write_to_all(rig, earlier)
    assert rig.device.state == state
    assert write_to_all(rig, result) == effects
    assert rig.device.state == after
    assert not rig.device.health.needs_resync
    assert rig.next() == Idle(inf)


def write_to_all(rig: Rig, result: str) -> str:
    rig.write(rig.device.tags[0].text)
    given, traffic = RESULTS[result]
    found = kinds(rig.conclude(rig.transacted(), given, traffic))
    if given is SILENCE:
        assert found == "-"
        found = kinds(rig.conclude(rig.transacted(), Settled(None)))
    return found


# Several polls at once


def test_polls_alongside_are_concluded_one_by_one_and_fail_together() -> None:
    rig = Rig(tcp_device())
    rig.bring(State.ONLINE)
    poll = rig.next()
    assert isinstance(poll, Poll)
    others = rig.engine.alongside(poll, rig.now)
    assert len(others) == rig.device.window - 1
    assert kinds(rig.conclude(poll, SILENCE)) == "-"
    assert rig.device.state == "online"  # until all are concluded
    for other in others[1:]:
        assert kinds(rig.conclude(other, [5])) == "good"
    assert kinds(rig.conclude(others[0], NOISE)) == "-"
    assert rig.device.state == "failing"
    settle = rig.next()
    assert isinstance(settle, Settle)
    assert settle.after is poll
    assert rig.device.health.outstanding == poll.block.span


@pytest.mark.parametrize(("beside", "state"), [(True, State.FAILING), (False, State.OFFLINE)])
def test_a_device_that_answers_beside_a_lost_request_is_not_offline_without_retries(
    beside: bool, state: State
) -> None:
    """It may take one request at a time. Probes of a network device are rare beside others."""
    rig = Rig(tcp_device(retries=0))
    rig.bring(State.ONLINE)
    rig.now += 1.0
    poll = rig.next()
    assert isinstance(poll, Poll)
    other, *_ = rig.engine.alongside(poll, rig.now)
    rig.engine._in_flight.open = {  # private: two polls are enough
        job: entry for job, entry in rig.engine._in_flight.open.items() if job in (poll, other)
    }
    rig.conclude(other, [5] if beside else SILENCE)
    rig.conclude(poll, SILENCE, took=0.5)
    rig.conclude(rig.transacted(), Settled(None), took=0.1)
    assert rig.device.state is state


# Results that no job can have


@pytest.mark.parametrize(
    ("situation", "result"),
    [
        ("online Poll", BadValue("not an address")),
        ("starting Probe", BadValue("not an address")),
        ("online Write", BadValue("not a value")),
        ("online WriteTogether", BadValue("not a value")),
        ("failing Confirm", BadValue("not a value")),
        ("online Command", None),
    ],
)
def test_a_result_that_the_job_cannot_have_is_raised(situation: str, result: Result) -> None:
    """Otherwise a poll would be lost, a probe repeated without a pause, a write acknowledged."""
    begin, setup = SITUATIONS[situation]
    rig = Rig()
    rig.bring(begin)
    job = setup(rig)
    with pytest.raises((BadValue, TypeError)):
        rig.conclude(job, result)


@pytest.mark.parametrize(("told_from", "proven"), [(1, False), (2, True)])
def test_an_unclear_write_counts_as_two_outstanding_requests(told_from: int, proven: bool) -> None:
    """Its reply may still arrive, or that to the resync which went with it."""
    rig = Rig()
    rig.bring(State.ONLINE)
    rig.write("D0")
    write = rig.next()
    assert isinstance(write, Write)
    rig.fail(write)
    probe = rig.transacted()
    assert isinstance(probe, Probe)
    rig.conclude(probe, Resynced(told_from))
    assert isinstance(rig.next(), Settle) is not proven


# What comes from outside


def test_a_request_is_refused_at_once_where_it_cannot_be_sent() -> None:
    rig = Rig()
    rig.bring(State.ONLINE)
    assert isinstance(rig.outcomes[rig.command("format")], BadValue)
    rig.note(rig.engine.lost(LOST, rig.now, rig.time))
    write = rig.write("D0")
    assert str(rig.outcomes[write]) == "unplugged"
    assert isinstance(rig.outcomes[write], LineDown)


def test_a_request_to_an_offline_device_is_refused_while_its_probe_is_not_allowed() -> None:
    rig = Rig(link_device(retries=0), link_device(station=2))
    first, second = rig.transacted(), None
    rig.conclude(first, Resynced(1))
    second = rig.transacted()
    assert isinstance(second, Probe)
    rig.conclude(second, Resynced(1))
    poll = rig.transacted()
    assert isinstance(poll, Poll)
    assert poll.device is rig.device
    rig.fail(poll)
    assert rig.device.state is State.OFFLINE
    assert isinstance(rig.outcomes[rig.write("D0")], Offline)


def test_a_short_probe_that_fails_leaves_a_starting_device_starting() -> None:
    rig = Rig(link_device(), link_device(station=2))
    for short in (True, False, True):
        probe = rig.transacted()
        while probe.device is not rig.device:
            rig.conclude(probe, Resynced(1) if isinstance(probe, Probe) else UNITS)
            probe = rig.transacted()
        assert isinstance(probe, Probe)
        assert (probe.timeout is not None) is short
        before = rig.device.state
        rig.conclude(probe, SILENCE)
        settle = rig.next()
        assert isinstance(settle, Settle)
        assert (settle.guard == 0.0) is short
        found = kinds(rig.conclude(settle, Settled(None)))
        if short:
            assert (rig.device.state, found) == (before, "-")
        else:
            assert (rig.device.state, found) == (State.OFFLINE, "bad:no-reply+offline")


def test_the_latest_of_several_waiting_values_takes_the_place_of_the_others() -> None:
    rig = Rig()
    rig.bring(State.ONLINE)
    first, second = rig.write("D5", 1), rig.write("D5", 2)
    assert isinstance(rig.outcomes[first], Busy)
    assert rig.next() is second


def test_no_more_requests_wait_than_the_queue_takes() -> None:
    rig = Rig()
    rig.bring(State.ONLINE)
    for _ in range(MOST_WAITING):
        rig.write("D0")
    assert rig.outcomes == {}
    assert isinstance(rig.outcomes[rig.write("D0")], Busy)


def test_a_waiting_request_ends_at_the_deadline() -> None:
    rig = Rig()
    rig.bring(State.ONLINE)
    write = rig.write("D0")
    assert rig.engine.deadline <= write.expires
    rig.now = write.expires - 0.01
    rig.note(rig.engine.expire(rig.now, rig.time))
    assert rig.engine.deadline == write.expires
    assert rig.outcomes == {}
    rig.now = write.expires
    rig.note(rig.engine.expire(rig.now, rig.time))
    assert str(rig.outcomes[write]) == "waited 5.0 s for the line; not sent"
    assert rig.engine.deadline > rig.now


def test_old_values_turn_bad_at_the_deadline() -> None:
    rig = Rig()
    rig.bring(State.ONLINE)
    rig.conclude(rig.transacted(), UNITS)
    read, found = rig.now, list[Effect]()
    while not found:
        assert rig.engine.deadline > rig.now
        rig.now = rig.engine.deadline
        found += rig.note(rig.engine.expire(rig.now, rig.time))
    assert kinds(found) == "bad:overdue"
    [poll] = rig.engine.schedule.polls(rig.device)
    [age] = worst_ages(polled_blocks([rig.device]))
    assert rig.now - read == pytest.approx(2 * age + rig.device.longest_reply)
    assert poll.reads.at is None


def test_an_expedited_poll_is_next_before_its_time() -> None:
    rig = Rig()
    rig.bring(State.ONLINE)
    rig.conclude(rig.transacted(), UNITS)
    assert isinstance(rig.next(), Idle)
    rig.engine.expedite(rig.device, rig.device.tags[0])
    poll = rig.next()
    assert isinstance(poll, Poll)
    assert rig.entry(poll).expedited


@pytest.mark.parametrize("stopped", [False, True], ids=["lost", "stopped"])
def test_the_end_of_the_line_ends_the_request_in_flight_and_the_waiting_ones(
    stopped: bool,
) -> None:
    rig = Rig()
    rig.bring(State.ONLINE)
    sent, waiting = rig.write("D2"), rig.command()
    assert rig.next() is sent
    if stopped:
        found = rig.note(rig.engine.stopped(rig.now))
        assert kinds(found) == "Unclear+LineDown"
    else:
        found = rig.note(rig.engine.lost(LOST, rig.now, rig.time))
        assert kinds(found) == "Unclear+offline+bad:line-down+LineDown"
    assert set(rig.outcomes) == {sent, waiting}
    assert not rig.engine.is_open
    assert rig.engine.deadline == inf
    rig.note(rig.engine.stopped(rig.now))  # a second end has no effect
    assert len(rig.outcomes) == 2


def test_a_reopened_line_probes_every_device_again() -> None:
    rig = Rig()
    rig.bring(State.ONLINE)
    rig.note(rig.engine.lost(LOST, rig.now, rig.time))
    rig.now += 1.0
    rig.note(rig.engine.opened(rig.now))
    assert isinstance(rig.next(), Probe)
    assert rig.engine.record.opened == 2
    assert rig.engine.record.trouble == ""


def test_bytes_outside_of_a_transaction_are_counted_and_forget_the_monitor_list() -> None:
    rig = Rig()
    rig.bring(State.ONLINE)
    rig.device.monitor.must_register((rig.device.blocks[0].span,))
    rig.note(rig.engine.received(b"noise", rig.now, rig.time))
    assert rig.engine.record.unasked == 5
    assert rig.device.monitor.registered == ()


def test_a_frame_that_is_no_reply_is_counted() -> None:
    rig = Rig()
    rig.bring(State.ONLINE)
    rig.note(rig.engine.unmatched(rig.device, Ack(1), rig.now, rig.time))
    assert rig.device.record.unasked == 1


def test_traffic_counts_as_time_of_the_wire() -> None:
    rig = Rig()
    rig.bring(State.ONLINE)
    assert rig.engine.record.busy == pytest.approx(37 * WIRE.character)
    assert rig.engine.record.turnarounds == 0.005
    assert rig.device.record.exchanges == 1
    assert rig.device.record.wire_time == pytest.approx(37 * WIRE.character + 0.005)
