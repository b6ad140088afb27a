"""A whole block that had to be split before is tried again: one refusal is enough."""

from gateway.engine.device.health import State
from gateway.engine.jobs.jobs import Poll
from gateway.errors import Refusal, Refused
from gateway.protocols.driver import Span
from gateway.protocols.modbus import ModbusRtu
from tests.engine.rig import REPLIED, Rig
from tests.sim.bench import WIRE
from tests.sim.plant import made_device, make_tag

NO_COMMAND = Refused("no such command", code="12", refusal=Refusal.OTHER)
WHOLE = Span("holding", 0, 12)


def test_a_trial_of_a_split_block_costs_one_refusal() -> None:
    driver = ModbusRtu(station=1)
    tags = [make_tag(f"holding:{n}", driver) for n in (0, 1, 10, 11)]
    rig = Rig(made_device("plc", driver, WIRE, driver.timing, tags, control=True))
    rig.bring(State.ONLINE)
    assert [block.span for block in rig.device.blocks] == [WHOLE]
    refused = 0
    for _ in range(30):
        job = rig.transacted()
        assert isinstance(job, Poll)
        lacks = job.span.start < 5 < job.span.start + job.span.size
        refused += lacks and job.span == job.block.span
        rig.conclude(job, NO_COMMAND if lacks else [0] * job.span.size, REPLIED)
    assert refused == 1 + rig.device.timing.retries + 1  # a search, and one trial: it is lasting
    assert [block.span for block in rig.device.blocks] == [
        Span("holding", 0, 2),
        Span("holding", 10, 2),
    ]
