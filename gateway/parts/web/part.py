"""The HTTP side as a part."""

from gateway.parts.web.settings import WebSection
from gateway.plant.part import Core, Kind, Part, Phase


def _make(core: Core) -> Part | None:
    config = core.config.part(WebSection)
    if config is None:
        return None
    from gateway.parts.web.server import Server  # imported only here: it costs time and memory

    return Server(config, core)


KIND = Kind(_make, Phase.SHOWING)
