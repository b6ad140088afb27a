"""A running gateway with two modems, and a client on Zenoh in another process."""

import asyncio
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from gateway.stations.vigor import VigorStation
from tests.e2e.processes import started, write_config
from tests.e2e.pty_modem import PATIENCE, PtyModem
from tests.serving.easy_link import frame
from tests.transport.modem import ModemModel
from tests.zenoh_peer import ZenohPeer, free_endpoint

SETTINGS = {"guard": "100ms"}
LATE = timedelta(seconds=5)  # a stamp is never new for an old value, but may be too old
D0 = "1C0002"  # its address and two bytes


async def calls_of(client: ZenohPeer, line: str) -> Any:
    [document] = await client.get(f"plant/@gateway/demo/lines/{line}")
    return document.json["calls"]


async def test_b3_8_a_plc_dials_in_and_another_is_dialled(tmp_path: Path) -> None:
    """The monitored PLC dials in, writes D0 and hangs up; a write dials out."""
    far, endpoint = VigorStation(1), free_endpoint()
    far.memory.write("D", 100, [17])
    replies: list[bytes] = []

    def heard(reply: bytes) -> bytes:
        replies.append(reply)
        return b""

    called = ModemModel(answers=lambda data: b"".join(far.hear(data, 0.0)))
    caller = ModemModel(answers=heard)
    async with PtyModem(called) as outgoing, PtyModem(caller) as incoming:
        lines = {
            "center": {
                "port": f"modem:{incoming.path}",
                "serve": True,
                "modem": SETTINGS,
                "devices": {
                    "vr1": {
                        "protocol": "vigor",
                        "station": 0,
                        "accept": ["D0"],
                        "tags": {"level": {"address": "D0", "history": True}},
                    }
                },
            },
            "site": {
                "port": f"modem:{outgoing.path}",
                "modem": {**SETTINGS, "number": "2620-4393", "idle": "200ms"},
                "devices": {
                    "pump": {
                        "protocol": "vigor",
                        "station": 1,
                        "tags": {
                            "level": {"address": "D100", "every": "15min"},
                            "limit": {"address": "D200", "every": "15min", "write": True},
                        },
                    }
                },
            },
        }
        config = write_config(
            tmp_path / "far.yaml", endpoint, lines, history={"path": str(tmp_path / "h.db")}
        )
        with started(config):
            async with ZenohPeer("client", connect=[endpoint]) as client:
                values = await client.subscribe("plant/**")
                # It dials once, reads, and hangs up.
                await values.next(lambda s: s.key == "plant/pump/level" and s.json["value"] == 17)
                await outgoing.until_online(False)
                assert "ATDT26204393" in called.commands
                # A call comes in.
                began = datetime.now(UTC)
                await incoming.until_ready()
                incoming.say(caller.ring())
                await incoming.until_online()
                incoming.say(frame(0, "61", f"{D0}FA00"))  # D0 = 250
                sample = await values.next(
                    lambda s: s.key == "plant/vr1/level" and s.json["value"] == 250
                )
                assert (
                    began - LATE <= datetime.fromisoformat(sample.json["time"]) <= datetime.now(UTC)
                )
                await incoming.until(lambda model: bool(replies))
                incoming.say(caller.drop())
                # A write dials at once, while the other line waits for its next call.
                [answer] = await client.get("plant/pump/limit/@set", b"9")
                assert answer.json["value"] == 9
                assert far.memory.read("D", 200) == [9]
                await outgoing.until_online(False)
                # The value stays, and history has it with the time of the call.
                [now] = await client.get("plant/vr1/level")
                assert now.json == sample.json
                [*_, kept] = await client.get("plant/vr1/level?_time=[now(-60s)..]")
                assert kept.json == sample.json
                assert called.calls == 2
                # The status counts both calls, once the second one has ended.
                async with asyncio.timeout(PATIENCE):
                    while (calls := await calls_of(client, "site"))["state"] != "idle":
                        await outgoing.until_online(False)
                assert (calls["made"], calls["failed"], calls["last_result"]) == (2, 0, "complete")
                assert 800 < calls["next"] <= 900
                taken = await calls_of(client, "center")
                assert (taken["state"], taken["made"], taken["next"]) == ("idle", 1, None)
