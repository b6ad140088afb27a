"""InfluxDB line protocol: values of the gateways to InfluxDB, Telegraf, or the standard output.

The time of a line is that of the sample. A value that becomes good again without a new sample has
the time of its return. While the server does not answer, lines wait in a queue, and are sent again
with the same time: a second copy replaces the first. Beyond the queue the oldest are lost. Lines
that the server refuses (status 400, 413 and 422) are dropped. Both are counted in `plc_bridge`.

    plc_bridge lost=120i,refused=0i,recovered=118i 1763640010000000000

What is missing is taken from the history of the gateway, for tags that have one: after a loss of
lines, after a time without the gateway, and with a state file after a restart of the bridge.
"""

import asyncio
import http.client
import sys
import time
import urllib.error
from collections import deque
from pathlib import Path
from typing import NamedTuple

from gateway.bridges.documents import Known, utc_now
from gateway.bridges.influx.gaps import Gaps
from gateway.bridges.influx.lines import line_of
from gateway.bridges.influx.server import request
from gateway.bridges.program import Gateways, opened, say
from gateway.bridges.remote_plant import RemotePlant
from gateway.errors import GatewayError, words_of

BATCH = 5000  # lines of one request
ANSWER_WITHIN = 10.0  # seconds
LONGEST_PAUSE = 30.0  # seconds between two attempts
REFUSED = (400, 413, 422)  # for ever; other errors are those of the server or of its settings
LOOK_EVERY = 1.0  # seconds: for gaps


class Line(NamedTuple):
    device: str
    time: str
    text: str


class Bridge:
    """Sends lines in their order, each until the server has answered."""

    def __init__(self, to: str | None, every: float, most: int, state: Path | None) -> None:
        self.plant: RemotePlant
        self._to, self._every, self._most = to, every, most
        self._lines: deque[Line] = deque()
        self._last: dict[str, tuple[str, bool]] = {}  # of each key: time, is good
        self._gaps = Gaps(state)
        self._news = asyncio.Event()
        self._lost = self._refused = self._recovered = 0
        self._said = (0, 0, 0)
        self._sends = True

    def described(self, _key: str, _meta: Known) -> None:
        pass

    def changed(self, key: str, known: Known) -> None:
        if known.get("reason") == "starting":
            return  # not read yet
        before, is_good = self._last.get(key), known["quality"] == "good"
        if before and is_good and not before[1] and known["time"] <= before[0]:
            known = known | {"time": utc_now()}
        self._last[key] = known["time"], is_good
        device = key.partition("/")[0]
        self._gaps.heard(device, answers=device in self.plant.trusted)
        self._add(key, known)
        while len(self._lines) > self._most:
            self._lose(self._lines.popleft())

    def _add(self, key: str, known: Known) -> None:
        self._lines.append(Line(key.partition("/")[0], known["time"], line_of(key, known)))
        self._news.set()

    def _lose(self, line: Line) -> None:
        self._lost += 1
        self._gaps.open(line.device, line.time)

    async def serve(self) -> None:
        """Sends the lines in batches."""
        pause = self._every
        while True:
            await self._news.wait()
            await asyncio.sleep(pause)
            self._news.clear()
            while self._lines:
                self._sends = await self._send()
                if not self._sends:
                    pause = min(2 * pause, LONGEST_PAUSE)
                    self._news.set()
                    break
                pause = self._every

    async def _send(self) -> bool:
        """Sends one batch. Returns False if it must be sent again."""
        batch = [self._lines.popleft() for _ in range(min(BATCH, len(self._lines)))]
        counts = self._lost, self._refused, self._recovered
        fields = "lost={}i,refused={}i,recovered={}i".format(*counts)
        note = [f"plc_bridge {fields} {time.time_ns()}"] if counts != self._said else []
        body = "\n".join([*(line.text for line in batch), *note]) + "\n"
        try:
            await asyncio.to_thread(self._post, body.encode())
        except BrokenPipeError:  # `| head` has read enough
            raise
        except (OSError, http.client.HTTPException) as error:
            if isinstance(error, urllib.error.HTTPError) and error.code in REFUSED:
                self._refused += len(batch)
                say(f"{len(batch)} lines refused: {error}, {error.read(300)!r}")
                return True
            self._lines.extendleft(reversed(batch))
            while len(self._lines) > self._most:
                self._lose(self._lines.popleft())
            say(
                f"not sent: {words_of(error)}; {len(self._lines)} lines wait, {self._lost} are lost"
            )
            return False
        for line in batch:
            self._gaps.sent(line.device, line.time)
        if note:
            say(f"since the start: {fields}")
            self._said = counts
        return True

    def _post(self, body: bytes) -> None:
        if self._to is None:
            sys.stdout.buffer.write(body)
            sys.stdout.buffer.flush()
            return
        request(self._to, body, ANSWER_WITHIN)

    async def recover(self) -> None:
        """Fills gaps from the history, while the server takes lines."""
        while True:
            await asyncio.sleep(LOOK_EVERY)
            await self._gaps.save()
            for device in sorted(self.plant.trusted) if self._sends else ():
                if since := self._gaps.take(device):
                    await self._recover(device, since)

    async def _recover(self, device: str, since: str) -> None:
        tags = [
            key
            for key, meta in self.plant.tags.items()
            if meta["history"] and key.startswith(f"{device}/")
        ]
        before = self._recovered
        try:
            for key in tags:
                async for found, lost in self.plant.past(key, f"[{since}..]"):
                    if lost is not None:
                        say(f"history of {key} since {since}: {lost}")
                    for known in found:
                        self._add(key, known)
                    self._recovered += len(found)
                    while len(self._lines) > BATCH:  # live lines go on, and none is lost for old
                        await asyncio.sleep(self._every)
        except GatewayError as error:
            say(f"history of {device} since {since}: {error}; again later")
            self._gaps.open(device, since)
        else:
            while self._lines:
                await asyncio.sleep(self._every)
            self._gaps.filled(device)
            if tags:
                say(f"{self._recovered - before} samples of {device} since {since} recovered")


async def bridge(
    gateways: Gateways, to: str | None, every: float, queue: int, state: Path | None
) -> None:
    """Serves until it is cancelled."""
    served = Bridge(to, every, queue, state)
    with await opened(gateways) as session:
        served.plant = RemotePlant(session, gateways.prefix, served.described, served.changed)
        async with asyncio.TaskGroup() as group:
            group.create_task(served.plant.follow())
            group.create_task(served.serve())
            group.create_task(served.recover())
