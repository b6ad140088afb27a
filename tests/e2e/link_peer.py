"""The byte-level Computer Link PLC of the protocol tests as a process at the end of a cable.

`python -m tests.e2e.link_peer STATION FORMAT PORT`. It prints `ready`, then executes
commands from its standard input and prints `ok …` after each:

    set D0100 5    what its program would do     get D0500    mute / speak   its answers are lost
    forget         its registered lists          say 1E61     on-demand data, unasked
    gone D0500     NAK 06 to whatever reads it   heard        the commands since this was last asked
"""

import os
import select
import sys

from tests.protocols.computer_link_peer import Peer

ENQ = b"\x05"
PAUSE = 0.02  # seconds without a byte that end a request in format 1


class Plc:
    def __init__(self, station: int, frame_format: int, port: str) -> None:
        self.peer = Peer(station, frame_format, True)
        self.port = os.open(port, os.O_RDWR | os.O_NOCTTY)
        self.mute = False
        self.heard: list[str] = []
        self._request = b""

    def listen(self) -> None:
        """Reads the available bytes and replies to each whole request."""
        self._request += os.read(self.port, 4096)
        while select.select([self.port], [], [], PAUSE)[0]:
            self._request += os.read(self.port, 4096)
        # A request that comes while this process had no time ends the one before.
        _, enq, last = self._request.rpartition(ENQ)
        request, self._request = enq + last, b""
        answer = self._answer(request)
        if answer and not self.mute:
            os.write(self.port, answer)

    def _answer(self, request: bytes) -> bytes:
        self.heard.append(request[5:7].decode())
        if request[1:5] == b"FFFF":  # the global flag, without a reply
            self.peer.devices["M8126"] = int(request[8:9])
            return b""
        return self.peer.hear(request)

    def obey(self, words: list[str]) -> object:
        match words:
            case ["set", name, value]:
                self.peer.devices[name] = int(value)
            case ["get", name]:
                return self.peer.devices.get(name, 0)
            case ["mute" | "speak" as how]:
                self.mute = how == "mute"
            case ["forget"]:
                self.peer.registered.clear()
            case ["gone", name]:
                self.peer.missing.add(name)
            case ["say", data]:
                os.write(self.port, self.peer.stx(data, "FE"))
            case ["heard"]:
                heard, self.heard = self.heard, []
                return " ".join(heard)
            case _:
                raise ValueError(words)
        return ""


def main(station: str, frame_format: str, port: str) -> None:
    plc = Plc(int(station), int(frame_format), port)
    print("ready", flush=True)
    while True:
        ready, _, _ = select.select([plc.port, sys.stdin], [], [])
        if plc.port in ready:
            plc.listen()
        if sys.stdin in ready:
            line = sys.stdin.readline()
            if not line:
                return
            print("ok", plc.obey(line.split()), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
