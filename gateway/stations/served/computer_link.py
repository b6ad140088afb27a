"""Computer Link stations of the gateway on one wire, formats 1 and 4.

A global (GW, to one station or to all) sets M8126, and RR and RS set M8035 to M8037, where the
master may write them.
"""

from gateway.protocols.computer_link.codec import ALL_STATIONS, FrameFormat, LinkCodec
from gateway.stations.computer_link.answers import LinkStation, addressed
from gateway.stations.computer_link.devices import Profile
from gateway.stations.computer_link.requests import RequestReader
from gateway.stations.served.answering import (
    NOISE,
    SILENCE,
    Answerer,
    Done,
    Heard,
    Stations,
    Wire,
)

_ADAPTER = 0.1  # seconds between two characters of a request that an adapter adds (D8129)
# The reply to PC, as the Mitsubishi models of these profiles reply.
_MODELS: dict[Profile, str] = {"liyan": "9E", "ex1s": "F2", "ex1n": "9E", "ex2n": "9D", "fx": "9D"}


class _Line:
    """All stations of the wire. Replies begin with STX, ACK or NAK: none is taken for a request."""

    def __init__(self, stations: Stations, wire: Wire) -> None:
        self._wire = wire
        self._stations: dict[int, LinkStation] = {}
        for number, (driver, registers) in stations.items():
            profile: Profile = getattr(driver, "profile", "liyan")
            self._stations[number] = LinkStation(number, registers, profile, _MODELS[profile])
        first = next(iter(stations.values())).driver
        self._frame_format: FrameFormat = getattr(first, "frame_format", 1)
        self._sum_check: bool = getattr(first, "sum_check", True)
        self._reader = RequestReader(self._frame_format, self._sum_check)

    def hear(self, data: bytes, now: float) -> Heard:
        self._reader.expire(now, self._wire.pause(_ADAPTER))
        texts = self._reader.feed(data, now)
        known = [addressed(text) for text in texts]
        ours = [number in self._stations or number == ALL_STATIONS for number in known]
        if not any(ours):
            return SILENCE
        if not ours[-1] or self._reader.begun > NOISE:
            return Heard(stale=sum(ours))
        return self._answer(known[-1], texts[-1])._replace(stale=sum(ours) - 1)

    def _answer(self, number: int | None, text: str) -> Heard:
        asked = [one for one in self._stations if number in (one, ALL_STATIONS)]
        reply, delay, done = b"", self._wire.silence, list[Done]()
        for one in asked:
            answer = self._stations[one].answer(text, sum_check=self._sum_check)
            if number != ALL_STATIONS and answer.reply is not None:
                reply = LinkCodec(self._frame_format, self._sum_check).encode(answer.reply)
                delay = max(delay, answer.wait)
            elif not answer.written:
                continue
            done.append(Done(one, answer.refused, answer.write, tuple(answer.written)))
        return Heard(reply, delay, tuple(done))


def computer_link(stations: Stations, wire: Wire) -> Answerer:
    """Returns the stations of a Computer Link line."""
    return _Line(stations, wire)
