"""A short slice of `make bridges`, and what it would notice."""

import math
from pathlib import Path

from tests.bridges.campaign import Campaign, Truth
from tests.bridges.conftest import Broker
from tests.e2e.processes import until


def test_nothing_is_good_after_a_broker_with_a_store_and_its_bridges_ended_together(
    mosquitto: Broker, tmp_path: Path
) -> None:
    with Campaign(tmp_path, seed=0, expire=1) as campaign:
        campaign.change()
        campaign.settle()
        for name in ("broker", "mqtt", "sparkplug", "opcua"):
            campaign.kill(name)
        until(campaign.nothing_good, "the clients have lost the broker and the server")
        campaign.start("broker")  # with what it has stored
        until(campaign.nothing_good, "what it has stored expires")
        for name in ("mqtt", "sparkplug", "opcua"):
            campaign.start(name)
        campaign.change()
        campaign.settle()
        assert campaign.broken == []


def test_a_value_that_is_shown_too_long_is_noticed() -> None:
    truth = Truth()
    truth.set("a/one", 7)
    assert truth.allows("a/one", 7, late=0)
    truth.set("a/one", None)
    assert truth.allows("a/one", None, late=0)
    assert [truth.allows("a/one", 7, late) for late in (60, 0)] == [True, False]
    assert not truth.allows("a/one", 8, late=math.inf)
