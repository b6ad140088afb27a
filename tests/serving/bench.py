"""A served line without a port: bytes of a master in, its reply and the samples out."""

import json
from collections.abc import Mapping
from functools import cache
from typing import Any

from gateway.config import Config, built
from gateway.parts.serving.served_line import ServedLine
from gateway.stations.served.answering import Answerer, Heard
from gateway.stations.served.registers import ServedTag
from gateway.stations.served.station import ServedStation
from gateway.tags import Reason, Sample, Tag, bad, good
from gateway.values import Value

SOURCES = {
    "speed": {"address": "D100"},
    "level": {"address": "D110", "type": "float32"},
    "run": {"address": "M5"},
    "gear": {"address": "D130"},
    "name": {"address": "D120", "type": "string[8]"},
    "steps": {"address": "D140", "type": "float32[2]"},
}
MIXER = {"protocol": "vigor", "station": 1, "tags": SOURCES}


@cache
def _config(lines: str) -> Config:
    return built({"gateway": {"state": "state.json"}, "lines": json.loads(lines)})


class Bench:
    """One served line. `values` are those of the other tags; None: bad."""

    def __init__(self, port: str, devices: Mapping[str, Any], **line: Any) -> None:
        self.values: dict[str, Value | None] = {}
        served = {"port": port, "serve": True, "devices": devices, **line}
        lines = {"hall": {"port": "/dev/ttyS99", "devices": {"mixer": MIXER}}, "panel": served}
        self.config = _config(json.dumps(lines))
        _, panel = self.config.lines
        self._tags = {tag.key: tag for one in self.config.devices for tag in one.tags}
        self.line = ServedLine(panel, self, self._sample)
        self.machine: Answerer = self.line.machine()
        self.samples_given: list[list[Sample]] = []
        self.online_given: list[tuple[str, bool]] = []
        self.now = 100.0

    def samples(self, samples: Any) -> None:
        self.samples_given.append(list(samples))

    def online(self, device: ServedStation, online: bool) -> None:
        self.online_given.append((device.name, online))

    def _sample(self, row: ServedTag) -> Sample | None:
        key = row.source or row.tag.key
        tag: Tag = self._tags[key]
        value = self.values.get(key)
        return bad(tag, Reason.STARTING, 0) if value is None else good(tag, value, 0)

    def hear(self, data: bytes, *, after: float = 1.0) -> Heard:
        """Passes bytes to the machine, so many seconds after the last, and takes the effects."""
        self.now += after
        heard = self.machine.hear(data, self.now)
        self.line.take(heard, self.now)
        return heard

    def ask(self, data: bytes, *, after: float = 1.0) -> bytes:
        heard = self.hear(data, after=after)
        reply = heard.reply
        while heard.more:
            heard = self.hear(b"", after=0.0)
            reply += heard.reply
        return reply

    def hex(self, text: str, *, after: float = 1.0) -> str:
        """As `ask`, in hex."""
        return self.ask(bytes.fromhex(text), after=after).hex(" ")

    @property
    def written(self) -> list[dict[str, Value | None]]:
        """The values of each event, by tag."""
        return [{one.tag.name: one.value for one in event} for event in self.samples_given]
