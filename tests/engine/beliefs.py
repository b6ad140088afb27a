"""The table of all that a line learns: evidence, contradiction, and how soon it is given up."""

from typing import NamedTuple

from gateway.engine.device.device import ECHO_PROVEN_FOR
from gateway.engine.device.health import FORGOTTEN
from gateway.engine.device.identity import SILENT_FOR
from gateway.engine.device.longer_reads import REFUSED_FOR as LONGER_REFUSED_FOR
from gateway.engine.device.monitor_list import REFUSED_FOR as LIST_REFUSED_FOR
from gateway.engine.device.probe_pace import (
    ALIVE_FOR,
    HOPE_FOR,
    LATE_FOR,
    PROBE_PAUSE,
    PROBE_SPREAD,
)
from gateway.engine.device.records import QUICKEST_OF
from gateway.engine.device.reply_shapes import WARY_FOR
from gateway.engine.device.second_requests import MOST_SILENT
from gateway.engine.device.station_silence import FORGOTTEN_AFTER
from gateway.engine.device.turnaround import LEARN_EVERY
from gateway.engine.device.twins import FOR
from gateway.engine.jobs.poll_entry import OWED
from gateway.engine.jobs.unanswered import SEEN_FOR
from gateway.engine.results.bit_writes import LACKED_FOR
from gateway.engine.results.busy_devices import LONGEST as LONGEST_BUSY
from gateway.engine.results.giving_way import LONGEST as LONGEST_WAY
from gateway.engine.results.pipelining import TRY_AGAIN
from gateway.planning.bad_addresses import RETRIES, SPLIT_LONGEST
from gateway.protocols.resync_kind import MISSES

AT_ONCE = 0.0


class Belief(NamedTuple):
    """Something that a line learns of an address, a device or its adapter. None is for ever."""

    name: str
    evidence: str
    contradicted_by: str
    then: str
    within: float  # seconds: given up so long after the contradiction, or the evidence, at most


BELIEFS = (
    Belief(
        "the adapter echoes",
        "a reply came behind its request",
        "a reply without its request",
        "a reply that equals the request is one again",
        AT_ONCE,
    ),
    Belief(
        "the adapter does not echo",
        "a reply without its request",
        "a reply behind its request; for a write also a reply that is too quick, "
        f"or no other reply for {ECHO_PROVEN_FOR:g} s",
        "an equal reply acknowledges nothing; a read proves the write",
        AT_ONCE,
    ),
    Belief(
        "turnaround",
        "measured, smoothed over ten replies",
        f"{LEARN_EVERY} replies with another one",
        "forecasts and plans use the new one",
        LEARN_EVERY * 1.0,
    ),
    Belief(
        "a reply cannot come sooner",
        f"the quickest of {QUICKEST_OF} replies or more",
        "a sooner one, which a resync proves",
        "replies that are as quick need no proof",
        AT_ONCE,
    ),
    Belief(
        "a shorter silence is enough",
        "replies to all polls after it",
        "a poll without a good reply, or bytes that answer nothing",
        "the safe silence",
        AT_ONCE,
    ),
    Belief(
        "a silence is too short",
        "a request after it was lost",
        "time: it is tried again, twice as late after each loss",
        "the shorter silence",
        FORGOTTEN_AFTER,
    ),
    Belief(
        "answers twice",
        "a reply to no request",
        "no such reply for ten minutes",
        "reads of its line need no proof; fewer shapes, shorter waits",
        WARY_FOR,
    ),
    Belief(
        "two stations have its number",
        "half of its last 16 requests were answered again, and a reply differed",
        "requests that are answered once, or ten minutes without a difference",
        "a reply that came alone is a value again, with its proof",
        FOR,
    ),
    Belief(
        "two stations had its number a short time ago",
        "two stations have it, and four of its last 16 requests had a new reply beside its own",
        "ten minutes without this evidence",
        "an acknowledged write is done, and a refused one certainly not",
        FOR,
    ),
    Belief(
        "takes one request at a time",
        "requests that were answered alone and not beside others",
        "a transaction in which all were answered; it is tried every hour",
        "requests share a transaction",
        TRY_AGAIN,
    ),
    Belief(
        "refused address",
        "the device refuses it, or is silent about it",
        "a good read; it is tried again after growing pauses",
        "it is read in its block",
        RETRIES[-1],
    ),
    Belief(
        "a block may hold an address about which the device is silent",
        "the device went offline at its read, or twice at the resync after it",
        "a good read of the block",
        "one lost reply is noise again, and does not halve it",
        AT_ONCE,
    ),
    Belief(
        "the station was silent about a read",
        "no reply to it",
        f"{OWED} replies in a row, or one that cannot be another one",
        "a reply that comes alone on a doubtful line is a value again, with its proof",
        AT_ONCE,
    ),
    Belief(
        "block too long",
        "both halves were read, the block not",
        "a good read of the whole; tried again after growing pauses",
        "it is one block again",
        SPLIT_LONGEST,
    ),
    Belief(
        "refuses monitor lists",
        "it refused its list twice, or was silent about it",
        "time: it is tried again",
        "the list is registered again",
        LIST_REFUSED_FOR,
    ),
    Belief(
        "refuses a longer read",
        "it refused, or was silent three times",
        "time: it is tried again",
        "the longer read alternates with the block",
        LONGER_REFUSED_FOR,
    ),
    Belief(
        "a bridge waits for a dead unit",
        "requests to others that were answered late",
        "shorter waits only, for an hour",
        "the shorter wait",
        SEEN_FOR,
    ),
    Belief(
        "does not change bits by itself",
        "it refused function 22, or was silent about it before it did it, or twice",
        "time: it is tried again",
        "function 22 in place of reading and writing the word",
        LACKED_FOR,
    ),
    Belief(
        "is silent about its identity",
        "three questions without a reply, before it ever told it",
        "time: it is asked again",
        "only the right device is read",
        SILENT_FOR,
    ),
    Belief(
        "a device is busy",
        "two busy replies in a row",
        "another reply; it is polled again after each pause",
        "it is polled as usual",
        LONGEST_BUSY,
    ),
    Belief(
        "a device takes more of the wire than planned",
        "its last turnaround was longer than that of the file, or at first, by a whole poll",
        "one that is not, by half a poll; it is polled after a minute at the latest",
        "its polls go when they are due",
        LONGEST_WAY,
    ),
    Belief(
        "a device that replies has no good values",
        f"none for {HOPE_FOR:g} s, while it was online",
        "a good value, or it goes offline; it is polled after a minute at the latest",
        "its polls go when they are due",
        LONGEST_WAY,
    ),
    Belief(
        "a device is offline",
        "more requests without a reply than `retries`",
        "a reply to a probe",
        "it is polled",
        PROBE_PAUSE * (1 + PROBE_SPREAD),
    ),
    Belief(
        "a device that is never read does not answer",
        "a write without a reply",
        "a reply to a probe, or a minute without a write",
        "it is written without a probe",
        FORGOTTEN + PROBE_PAUSE * (1 + PROBE_SPREAD),
    ),
    Belief(
        "noise destroys its replies",
        "damaged replies in the last 10 s, and no late one on the line for a minute",
        "a late reply, or no damaged one",
        "it is waited for late replies again, and resyncs are patient",
        ALIVE_FOR,
    ),
    Belief(
        "the device lacks a read with a form of its own",
        "a refusal of this resync",
        "ten minutes",
        "one such resync proves several reads",
        WARY_FOR,
    ),
    Belief(
        "the device is silent about second requests of resyncs",
        f"{MOST_SILENT} of them without a reply, and no late reply for a minute",
        "ten minutes",
        "their replies have a form that was not requested for long",
        WARY_FOR,
    ),
    Belief(
        "the kind of resync that a station answers",
        "a reply to a loopback, or to three reads after lost loopbacks",
        f"{MISSES} loopbacks in a row without a reply, or two reads",
        "both kinds are sent in turn",
        MISSES * PROBE_PAUSE * (1 + PROBE_SPREAD),
    ),
    Belief(
        "a station replies later than late_guard",
        "a reply of the station behind all requests",
        "a minute without one",
        "a second request whose form is unanswered waits for twice that time of quiet",
        LATE_FOR,
    ),
    Belief(
        "a device that returns is as quick as before",
        "its measured turnaround",
        "a sound frame after a short probe",
        "the next probe waits for the whole reply_timeout, and is due",
        AT_ONCE,
    ),
    Belief(
        "earlier requests are kept",
        "the line or the device is new",
        "a wire that was quiet for reply_timeout and late_guard",
        "one resync is enough",
        AT_ONCE,
    ),
)


def table() -> str:
    """Returns the beliefs as a table of Markdown."""
    head = "| belief | evidence | contradicted by | then | given up |\n|---|---|---|---|---|"
    rows = (
        f"| {one.name} | {one.evidence} | {one.contradicted_by} | {one.then} | {_within(one)} |"
        for one in BELIEFS
    )
    return "\n".join((head, *rows))


def _within(belief: Belief) -> str:
    if belief.within == AT_ONCE:
        return "at once"
    if belief.name == "turnaround":
        return f"after {belief.within:g} replies"
    return f"within {belief.within:g} s"
