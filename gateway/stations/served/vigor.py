"""Vigor stations of the gateway on one wire."""

from gateway.protocols.vigor.codec import ACK, GOOD, READ, RequestReader, encode
from gateway.stations.served.answering import (
    NOISE,
    SILENCE,
    Answerer,
    Answering,
    Done,
    Heard,
    Stations,
    Wire,
)
from gateway.stations.vigor import addressed, answer

_ADAPTER = 0.1  # seconds between two characters of a request that an adapter adds


class _Line:
    """All stations of the wire. Replies begin with ACK, so none is taken for a request."""

    def __init__(self, stations: Stations, wire: Wire) -> None:
        self._stations = stations
        self._wire = wire
        self._reader = RequestReader()
        self._at = float("-inf")  # the time of the last bytes

    def hear(self, data: bytes, now: float) -> Heard:
        if now - self._at > self._wire.pause(_ADAPTER):
            self._reader = RequestReader()  # half a request is no beginning of another one
        self._at = now
        requests = self._reader.feed(data)
        stations = [self._addressed(request) for request in requests]
        ours = len([station for station in stations if station is not None])
        if not ours:
            return SILENCE
        station = stations[-1]
        if station is None or self._reader.begun > NOISE:
            return Heard(stale=ours)
        reply, written = answer(station.driver.station, station.registers, requests[-1])
        refused = "" if reply.status == GOOD else reply.status
        done = Done(reply.station, refused, reply.command != READ, tuple(written))
        return Heard(encode(reply), self._wire.silence, (done,), ours - 1)

    def _addressed(self, request: bytes) -> Answering | None:
        """Returns the station of a request; None for another one.

        An ACK begins the reply of another station: the request before it has lost its end.
        """
        number = None if ACK in request else addressed(request)
        return None if number is None else self._stations.get(number)


def vigor(stations: Stations, wire: Wire) -> Answerer:
    """Returns the stations of a Vigor line."""
    return _Line(stations, wire)
