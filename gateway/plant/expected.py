"""The forecasts of the lines of a running gateway."""

from collections.abc import Callable, Sequence

from gateway.config import Config
from gateway.engine.device.device import Device
from gateway.engine.forecast import LineForecast, forecast

Adjust = Callable[[Config, Sequence[LineForecast]], Sequence[LineForecast]]


def _as_they_are(_: Config, lines: Sequence[LineForecast]) -> Sequence[LineForecast]:
    return lines


def polls_of(
    config: Config, report: Callable[[str, float], None] | None = None
) -> list[LineForecast]:
    """Calculates the load and the worst ages of each polled line of a file, without its transfers.
    Takes seconds for a large file.

    `report` receives the name of this step and the share of it that is done.
    """
    found = []
    for line in config.lines:
        if line.serve:
            continue
        devices = [Device(device, line.wire) for device in line.devices if device.enabled]
        found.append(forecast(line.name, devices, line.wire))
        if report is not None:
            report("planning the requests", len(found) / len(config.lines))
    return found


class Expected:
    """The forecast of each planned line, as `check` prints it for the same file."""

    def __init__(self, config: Callable[[], Config]) -> None:
        """`config`: the present content of the file."""
        self._config = config
        self._adjust: Adjust = _as_they_are
        self._polls: dict[str, LineForecast] = {}  # by line, polls alone
        self._found: tuple[Config | None, dict[str, LineForecast]] = (None, {})

    def adjust(self, adjust: Adjust) -> None:
        """Adds the requests of a part to the polls."""
        self._adjust = adjust
        self._found = (None, {})

    def take(self, line: LineForecast) -> None:
        """Takes over the forecast of the polls of a line."""
        self._polls[line.name] = line
        self._found = (None, {})

    def drop(self, line: str) -> None:
        self._polls.pop(line, None)
        self._found = (None, {})

    def of(self, config: Config) -> Sequence[LineForecast]:
        """Returns the forecasts of another file, adjusted. A thread may do it: it takes long."""
        return self._adjust(config, polls_of(config))

    def lines(self) -> dict[str, LineForecast]:
        """Returns the forecasts by line, adjusted once for each change."""
        config = self._config()
        if self._found[0] is not config:
            whole = self._adjust(config, [*self._polls.values()])
            self._found = config, {one.name: one for one in whole}
        return self._found[1]
