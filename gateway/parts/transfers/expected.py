"""The forecasts of the lines of a running gateway, with the writes of its transfers."""

from collections.abc import Callable

from gateway.config import Config
from gateway.engine.forecast import LineForecast
from gateway.parts.transfers.forecast import transfer_forecasts, with_transfers


class Expected:
    """The forecast of each planned line, as `check` prints it for the same file."""

    def __init__(self, config: Callable[[], Config]) -> None:
        """`config`: the present content of the file."""
        self._config = config
        self._polls: dict[str, LineForecast] = {}  # by line, without transfers
        self._found: tuple[Config | None, dict[str, LineForecast]] = (None, {})

    def take(self, line: LineForecast) -> None:
        """Takes over the forecast of the polls of a line."""
        self._polls[line.name] = line
        self._found = (None, {})

    def drop(self, line: str) -> None:
        self._polls.pop(line, None)
        self._found = (None, {})

    def lines(self) -> dict[str, LineForecast]:
        """Returns the forecasts by line. The writes are calculated once for each change."""
        config = self._config()
        if self._found[0] is not config:
            polls = [*self._polls.values()]
            whole = with_transfers(polls, transfer_forecasts(config, polls))
            self._found = config, {one.name: one for one in whole}
        return self._found[1]
