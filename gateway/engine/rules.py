"""The list of the rules of a line. A new rule is one module in `results/` and one line here."""

from collections.abc import Sequence
from dataclasses import dataclass

from gateway.engine.device.device import Device
from gateway.engine.device.records import LineRecord
from gateway.engine.effects import Effects
from gateway.engine.results.bit_writes import BitWrites
from gateway.engine.results.broadcast_replies import BroadcastReplies
from gateway.engine.results.busy_devices import BusyDevices
from gateway.engine.results.giving_way import GivingWay
from gateway.engine.results.health_rules import HealthRules
from gateway.engine.results.identities import Identities
from gateway.engine.results.line_silence import LineSilence
from gateway.engine.results.listening import Listening, listens
from gateway.engine.results.pipelining import Pipelining
from gateway.engine.results.request_expiry import RequestExpiry
from gateway.engine.results.rule import Rule
from gateway.engine.results.shorter_silences import ShorterSilences
from gateway.engine.results.staleness import Staleness
from gateway.engine.results.stray import Stray
from gateway.engine.results.unsolicited import UnsolicitedFrames
from gateway.engine.schedule.in_flight import InFlight
from gateway.engine.schedule.schedule import Schedule
from gateway.planning.wire_timing import WireTiming


@dataclass(frozen=True, slots=True)
class LineState:
    """The state of one line that its rules share."""

    name: str
    devices: Sequence[Device]
    wire: WireTiming
    record: LineRecord
    schedule: Schedule
    in_flight: InFlight
    staleness: Staleness
    health: HealthRules
    effects: Effects


def rules_of(line: LineState) -> Sequence[Rule]:
    """Returns the rules of a line, in the order in which they are asked."""
    devices, effects = line.devices, line.effects
    if listens(devices):
        return (Listening(devices, line.wire, line.health, effects),)
    silence = LineSilence(line.schedule, devices, line.in_flight)
    return (
        silence,
        ShorterSilences(line.name, devices, line.in_flight, effects),
        Pipelining(line.in_flight, effects),
        BusyDevices(),
        GivingWay(devices, line.schedule, line.in_flight),
        BroadcastReplies(devices),
        BitWrites(),
        Identities(devices, line.schedule, line.in_flight, effects),
        Stray(line.name, devices, line.health, effects, silence.heard),
        RequestExpiry(line.schedule.requests, effects),
        line.staleness,
        UnsolicitedFrames(devices, line.health, effects),
    )
