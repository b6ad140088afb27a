"""At the running gateway: a station gets slow, and does not say so in the file."""

from pathlib import Path
from time import monotonic

from tests.attacks.slave import program_on
from tests.attacks.test_false_acknowledgements import is_good
from tests.attacks.test_returning_stations import Stations, device
from tests.zenoh_peer import ZenohPeer

EVERY, TURNAROUND = 0.5, 0.9  # seconds: each of its exchanges is longer than a period of the others
SLOW, OTHER = 3, 1  # stations
POLLS = 20  # of the other station


async def diagnosis(client: ZenohPeer) -> str:
    [answer] = await client.get("plant/@gateway/*/devices/c")
    return str(answer.json["diagnosis"])


async def share(stations: Stations) -> float:
    """Returns the share of its polls that the other station gets."""
    since, begun = len(stations.heard), monotonic()
    await stations.until(lambda: stations.asked(OTHER, since) > POLLS)
    return POLLS * EVERY / (monotonic() - begun)


async def test_a_slow_station_costs_the_others_no_polls(tmp_path: Path) -> None:
    """Two thirds of them were lost: the three took turns."""
    stations = Stations(lambda n: n < 100)
    timing = {"reply_timeout": "3s", "turnaround": "50ms", "late_guard": "50ms"}
    devices = {name: device(n, "500ms", **timing) for n, name in enumerate("abc", 1)}
    async with program_on(stations, tmp_path, devices) as (_, client):
        values = await client.subscribe("plant/c/w0")
        await values.next(is_good)
        assert await diagnosis(client) == ""
        stations.slow[SLOW] = TURNAROUND
        since = len(stations.heard)
        await stations.until(lambda: stations.asked(SLOW, since) > 1)
        since = len(stations.heard)
        assert await share(stations) > 0.75
        assert stations.asked(SLOW, since) < POLLS / 2
        assert (await diagnosis(client)).startswith("A poll takes 0.9")
