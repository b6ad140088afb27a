"""Decides if a write or command is accepted, before its key and value are looked at."""

import asyncio
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

import orjson
import zenoh

from gateway.contract.access.signatures import LONGEST
from gateway.contract.access.writers import EARLIEST, LATEST, Writers
from gateway.contract.foreign import Foreign
from gateway.contract.parsing import check_encoding
from gateway.engine.jobs.requests import WRITE_EXPIRY
from gateway.errors import BadValue, Busy
from gateway.line.send_permit import SendPermit
from gateway.plant.saved_file import SavedFile
from gateway.plant.threads import off_loop

AHEAD = LATEST + EARLIEST  # seconds
# Seconds that a write waits for the disk. A disk that hangs or is full keeps no operator from
# writing.
_PATIENCE = 0.5


class Sender(NamedTuple):
    """The client of a query or put. `arrived`: when it reached the process, by the loop's clock.

    `encoding`: of the payload, as Zenoh names it; empty for none.
    """

    session: str | None = None  # Zenoh's id, if the client sends it
    attachment: bytes | None = None
    arrived: float = 0.0
    encoding: str = ""


class Accepted(NamedTuple):
    """`by`: the client, if known. After `within` seconds the request must not be sent any more."""

    by: str | None
    within: float


class AcceptedUntil:
    """Keeps on disk until when signatures were accepted, so that a restart accepts none again.

    The time on disk is always later than that of any accepted signature, by some seconds. So most
    writes do not wait for the disk. Belongs to the event loop.
    """

    def __init__(self, path: Path) -> None:
        self._file = SavedFile(path)
        # The time until which an earlier process may have accepted, in seconds since 1970.
        self.floor = self._file.load(_parse) or 0.0
        self._kept = self.floor
        self._saving: asyncio.Task[None] | None = None

    async def keep(self, newest: float) -> None:
        """Returns when a restart refuses a signature of this time, or the disk took too long."""
        if newest <= self._kept:
            return
        if self._saving is None or self._saving.done():
            self._saving = asyncio.create_task(self._save(newest + AHEAD))
        await asyncio.wait([self._saving], timeout=_PATIENCE)

    async def _save(self, until: float) -> None:
        await off_loop(self._file.save, orjson.dumps({"accepted_until": until}))
        if self._file.trouble is None:
            self._kept = until


def _parse(found: object) -> float:
    """Raises `ValueError`."""
    match found:
        case {"accepted_until": int() | float() as until} if 0 <= until < 2**36:
            return float(until)
    raise ValueError("no time of accepted signatures")


class Acceptance:
    """Refuses what is too old, and what comes from no writer."""

    def __init__(
        self,
        duty: SendPermit,
        writers: Writers | None,
        wall: Callable[[], int] = time.time_ns,
        accepted: AcceptedUntil | None = None,
    ) -> None:
        """Without `writers` Zenoh alone decides who may write. `wall`: ns since 1970. Without
        `accepted` a signature may count again after a restart with a clock that was set back."""
        self._duty = duty
        self._writers = writers
        self._accepted = accepted
        self._wall = wall

    @property
    def signed(self) -> bool:
        """Requests need the signature of a writer."""
        return self._writers is not None

    def begin(self) -> None:
        """Call it when the gateway becomes active."""
        if self._writers is not None:
            self._writers.begin()

    def accept(self, key: str, data: bytes | None, sender: Sender) -> Accepted:
        """`key` and `data` as received. Raises `NotAllowed`, `Repeated`, `BadValue` for another
        encoding than JSON, and `Busy` for a request of the past."""
        check_encoding(sender.encoding)
        now = asyncio.get_running_loop().time()
        if why := self._duty.why_not(sender.arrived, now):
            raise Busy(why)
        by = sender.session
        if self._writers is not None:
            by = self._writers.writer(key, data or b"", sender.attachment)
        waited = now - sender.arrived
        if (made := _time_of(sender.attachment)) is not None:
            waited = max(waited, self._wall() / 1e9 - made)
        if waited >= WRITE_EXPIRY:
            raise Busy(f"it is {waited:.1f} s old; not sent")
        return Accepted(by, WRITE_EXPIRY - waited)

    async def kept(self) -> None:
        """Returns when no restart can accept again what was accepted. Nothing is sent before."""
        if self._writers is not None and self._accepted is not None:
            await self._accepted.keep(self._writers.newest)


def sender(message: zenoh.Query | zenoh.Sample, arrived: float) -> Sender:
    """Returns what is known of the client: most clients send neither session nor attachment."""
    source, attached = message.source_info, message.attachment
    return Sender(
        None if source is None else str(source.source_id.zid),
        None if attached is None or len(attached) > LONGEST else attached.to_bytes(),
        arrived,
        encoding_of(message),
    )


def encoding_of(message: zenoh.Query | zenoh.Sample) -> str:
    """Returns Zenoh's name of the payload's encoding; empty for a query without a payload."""
    return "" if message.encoding is None else str(message.encoding)


def _time_of(attachment: bytes | None) -> float | None:
    """Returns the client's own time, in seconds since 1970, if it sends one."""
    try:
        made = Foreign.parse(attachment or b"", LONGEST).text("time", LONGEST)
        return datetime.fromisoformat(made).timestamp()
    except (BadValue, ValueError, OverflowError):
        return None
