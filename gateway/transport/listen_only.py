"""The port of a listen-only line: nothing can be written to it."""

from gateway.transport.port import Port


class ListenOnlyPort:
    """A `Port` whose `write` raises, whoever calls it: another master owns the wire."""

    def __init__(self, port: Port) -> None:
        self._port = port

    def write(self, data: bytes) -> None:
        raise RuntimeError(f"a listen-only line was to send {data.hex(' ')}: nothing was sent")

    async def close(self) -> None:
        await self._port.close()
