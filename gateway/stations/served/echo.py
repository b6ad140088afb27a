"""The echo of a two-wire adapter, on the side of a station: its own reply comes back."""

from gateway.stations.served.answering import Wire

_LATENCY = 0.03  # seconds of an adapter that collects bytes


class Echo:
    """Recognizes the reply of this station where it would be taken for a request.

    Some replies of Modbus are equal to their requests. Without `echo` in the file, the first frame
    after a reply shows if the adapter echoes. Until then a frame that is equal to the reply, and
    arrives while the reply is on the wire, counts as its echo: no master is that fast.
    """

    def __init__(self, wire: Wire) -> None:
        self._character = wire.character
        self._known = wire.echo
        self._reply = b""  # the reply whose echo may still arrive
        self._by = 0.0

    @property
    def pending(self) -> bytes:
        """The echo that may arrive next; empty: none."""
        return self._reply

    def sent(self, reply: bytes, now: float) -> bytes:
        """Notes a reply. Returns `pending`."""
        if self._known is not False:
            self._reply = reply
            self._by = now + 2 * len(reply) * self._character + _LATENCY
        return self._reply

    def is_echo(self, frame: bytes, now: float) -> bool:
        """Returns True for the frame that is the echo of the last reply."""
        reply, self._reply = self._reply, b""
        if not reply:
            return False
        if frame == reply and (self._known or now <= self._by):
            return True
        if self._known is None and frame != reply:
            self._known = False
        return False
