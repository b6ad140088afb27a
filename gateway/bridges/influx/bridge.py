"""InfluxDB line protocol: values of the gateway to InfluxDB, Telegraf, or the standard output.

`--to` is the address of a write API: InfluxDB 1 (`/write?db=plant`), 2 and 3 (with the token in
`INFLUX_TOKEN`), VictoriaMetrics, or Telegraf's `inputs.influxdb_v2_listener`. Without it the lines
go to the standard output, for Telegraf's `inputs.execd`.

    plc,device=mixer,name=speed value=12.5,good=true 1763640000123456000
    plc,device=mixer,name=name text="AB",good=true 1763640000123456000
    plc,device=mixer,name=recipe value_0=1.0,value_1=5.0,good=true 1763640000123456000
    plc,device=mixer,name=speed good=false,reason="no-reply" 1763640003500000000
    plc_bridge lost=120i,refused=0i 1763640010000000000

* A value at an end of its clamp has `limited="low"` or `limited="high"`.
* An array has a field for each element, `value_0`, `value_1` ...
* Numbers and bits (0, 1) are in `value`, texts and the names of an `enum` in `text`. Beyond 2^53 a
  number is exact in `text` only.
* The time is that of the sample. A value that becomes good again without a new sample has the time
  of its return.
* An uncertain sample, outside the range of its sensor, has its value and `good=false`.
* A bad sample has no value. A chart of the last value must look at the last `good` too.
* While the server does not answer, up to `--queue` lines wait. They are sent again with the same
  time, so that a second copy replaces the first. Beyond that the oldest are lost. Lines that the
  server refuses (status 400, 413 and 422) are dropped. Both are counted, on the standard error
  output and in `plc_bridge`. Query the history of the gateway to fill the gap: docs/history.md.
"""

import asyncio
import http.client
import os
import sys
import time
import urllib.error
import urllib.request
from collections import deque
from datetime import datetime

from gateway.bridges.documents import Known, utc_now
from gateway.bridges.program import Gateways, opened, say
from gateway.bridges.remote_plant import RemotePlant

BATCH = 5000  # lines of one request
ANSWER_WITHIN = 10.0  # seconds
LONGEST_PAUSE = 30.0  # seconds between two attempts
REFUSED = (400, 413, 422)  # for ever; other errors are those of the server or of its settings


def line_of(key: str, known: Known) -> str:
    device, _, tag = key.partition("/")
    value = known["value"]
    good = "good=true"
    if known["quality"] != "good":
        good = f"good=false,reason={quoted(known.get('reason', ''))}"
    if value is None:
        fields = good
    elif isinstance(value, list):
        fields = ",".join(f"value_{n}={float(one)!r}" for n, one in enumerate(value)) + f",{good}"
    elif isinstance(value, str):
        fields = f"text={quoted(value)},{good}"
    else:
        fields = f"value={float(value)!r},{good}"
        if isinstance(value, int) and abs(value) > 2**53:
            fields += f",text={quoted(str(value))}"
        elif "text" in known:
            fields += f",text={quoted(str(known['text']))}"
    if "limited" in known:
        fields += f",limited={quoted(known['limited'])}"
    origin = f",origin={known['origin']}" if "origin" in known else ""
    nanoseconds = round(datetime.fromisoformat(known["time"]).timestamp() * 1_000_000) * 1000
    return f"plc,device={device},name={tag}{origin} {fields} {nanoseconds}"


def quoted(text: str) -> str:
    """Returns a field's text; the protocol has no escape for a line's end."""
    text = " ".join(text.splitlines()).replace("\\", "\\\\").replace('"', '\\"')
    return f'"{text}"'


class Bridge:
    def __init__(self, to: str | None, every: float, most: int) -> None:
        self._to, self._every, self._most = to, every, most
        self._lines: deque[str] = deque()
        self._last: dict[str, tuple[str, bool]] = {}  # of each key: time, is good
        self._news = asyncio.Event()
        self._lost = self._refused = 0
        self._said = (0, 0)

    def described(self, _key: str, _meta: Known) -> None:
        pass

    def changed(self, key: str, known: Known) -> None:
        if known.get("reason") == "starting":
            return  # not read yet
        before, is_good = self._last.get(key), known["quality"] == "good"
        if before and is_good and not before[1] and known["time"] <= before[0]:
            known = known | {"time": utc_now()}
        self._last[key] = known["time"], is_good
        self._lines.append(line_of(key, known))
        self._drop()
        self._news.set()

    def _drop(self) -> None:
        while len(self._lines) > self._most:
            self._lines.popleft()
            self._lost += 1

    async def serve(self) -> None:
        """Sends the lines in batches, in their order, each until the server has answered."""
        pause = self._every
        while True:
            await self._news.wait()
            await asyncio.sleep(pause)
            self._news.clear()
            while self._lines:
                if not await self._send():
                    pause = min(2 * pause, LONGEST_PAUSE)
                    self._news.set()
                    break
                pause = self._every

    async def _send(self) -> bool:
        """Sends one batch. Returns False if it must be sent again."""
        batch = [self._lines.popleft() for _ in range(min(BATCH, len(self._lines)))]
        counts = self._lost, self._refused
        note = f"plc_bridge lost={counts[0]}i,refused={counts[1]}i {time.time_ns()}"
        body = "\n".join([*batch, *([note] if counts != self._said else [])]) + "\n"
        try:
            await asyncio.to_thread(self._post, body.encode())
        except BrokenPipeError:
            raise SystemExit("the standard output is closed") from None
        except (OSError, http.client.HTTPException) as error:
            if isinstance(error, urllib.error.HTTPError) and error.code in REFUSED:
                self._refused += len(batch)
                say(f"{len(batch)} lines refused: {error}, {error.read(300)!r}")
                return True
            self._lines.extendleft(reversed(batch))
            self._drop()
            say(f"not sent: {error}; {len(self._lines)} lines wait, {self._lost} are lost")
            return False
        if counts != self._said:
            say(f"{counts[0]} lines lost and {counts[1]} refused since the start")
            self._said = counts
        return True

    def _post(self, body: bytes) -> None:
        if self._to is None:
            sys.stdout.buffer.write(body)
            sys.stdout.buffer.flush()
            return
        token = os.environ.get("INFLUX_TOKEN")
        headers = {"Content-Type": "text/plain; charset=utf-8"}
        headers |= {"Authorization": f"Token {token}"} if token else {}
        request = urllib.request.Request(self._to, body, headers)  # noqa: S310
        with urllib.request.urlopen(request, timeout=ANSWER_WITHIN):  # noqa: S310
            pass


async def bridge(gateways: Gateways, to: str | None, every: float, queue: int) -> None:
    """Serves until it is cancelled."""
    served = Bridge(to, every, queue)
    with await opened(gateways) as session:
        plant = RemotePlant(session, gateways.prefix, served.described, served.changed)
        async with asyncio.TaskGroup() as group:
            group.create_task(plant.follow())
            group.create_task(served.serve())
