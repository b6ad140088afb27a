"""One master on one port of a served line: its bytes, and the reply that waits."""

import asyncio
from typing import TYPE_CHECKING

from gateway.errors import CallEnded, LineDown
from gateway.stations.served.answering import NOISE, Answerer, Heard
from gateway.transport import Port

if TYPE_CHECKING:
    from gateway.parts.serving.served_line import ServedLine


class Conversation:
    """One master on one port: a wire, or one TCP connection."""

    def __init__(self, line: "ServedLine", *, network: bool = False) -> None:
        """`network`: one of several connections."""
        self.trouble = ""
        self._line = line
        self._network = network
        self._may_write = True
        self._machine: Answerer
        self._port: Port | None = None
        self._reply: asyncio.TimerHandle | None = None
        self._closing: asyncio.Task[None] | None = None
        self._following = 0  # bytes since the request of the waiting reply

    def opened(self, port: Port) -> None:
        self._port = port
        self._may_write = self._line.may_write(port)
        self._machine = self._line.machine(may_write=self._may_write)

    def received(self, data: bytes) -> None:
        line, now = self._line, asyncio.get_running_loop().time()
        line.heard(data)
        if self._port is None:
            return
        if line.why_not(now):  # what waited in the system while this process was held
            self._begin_again()
            return
        heard = self._machine.hear(data, now)
        if not heard.echo:
            self._following += len(data)
        if self._following > NOISE:
            self._cancel()
        while heard.more:
            self._take(heard, now)
            heard = self._machine.hear(b"", now)
        self._take(heard, now)

    def _take(self, heard: Heard, now: float) -> None:
        if heard.reply:
            self._following = 0
            if heard.delay:
                loop = asyncio.get_running_loop()
                self._reply = loop.call_at(now + heard.delay, self._send, heard.reply)
            else:
                self._send(heard.reply)
        self._line.take(heard, now)
        if heard.lost:
            self._begin_again()

    def _begin_again(self) -> None:
        """Drops what was received. A connection is closed: its next frame begins anywhere."""
        self._cancel()
        self._machine = self._line.machine(may_write=self._may_write)
        if self._network and self._port is not None:
            self._closing = asyncio.create_task(self._port.close())
            self._port = None

    def _send(self, reply: bytes) -> None:
        self._reply = None
        if self._port is None:
            return
        self._line.sent(reply)
        try:
            self._port.write(reply)
        except LineDown as error:
            self.lost(error)

    def _cancel(self) -> None:
        if self._reply is not None:
            self._reply.cancel()
            self._reply = None
            self._line.unsent += 1

    def call_began(self) -> None:
        self._line.call_began()

    def lost(self, error: Exception) -> None:
        if isinstance(error, CallEnded):  # the next call is another master's
            self._begin_again()
            self._line.call_ended()
            return
        self.close()
        self.trouble = str(error)
        if not self._network:
            self._line.ended()

    def close(self) -> None:
        self._cancel()
        self._port = None
