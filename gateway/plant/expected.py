"""The forecasts of the lines of a running gateway."""

from collections.abc import Callable, Sequence

from gateway.config import Config
from gateway.engine.forecast import LineForecast

Adjust = Callable[[Config, Sequence[LineForecast]], Sequence[LineForecast]]


def _as_they_are(_: Config, lines: Sequence[LineForecast]) -> Sequence[LineForecast]:
    return lines


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

    def lines(self) -> dict[str, LineForecast]:
        """Returns the forecasts by line, adjusted once for each change."""
        config = self._config()
        if self._found[0] is not config:
            whole = self._adjust(config, [*self._polls.values()])
            self._found = config, {one.name: one for one in whole}
        return self._found[1]
