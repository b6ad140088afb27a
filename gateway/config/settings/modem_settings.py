"""Settings of a modem: docs/modem.md."""

import re
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from gateway.config.messages import shown
from gateway.config.settings.setting_types import Interval, Parsed
from gateway.errors import ConfigError

# The rest are signs between digits; `,` is a pause and W a wait for the dial tone.
NUMBER_PATTERN = r"^[TPtp]?[0-9*#+ABCDWabcdw,!@ ()./-]*[0-9*#][0-9*#+ABCDWabcdw,!@ ()./-]*$"
_NUMBER = re.compile(NUMBER_PATTERN)
_INIT_PATTERN = r"^[Aa][Tt][ -~]{0,78}$"
_INIT = re.compile(_INIT_PATTERN)
_LEFT_OUT = re.compile(r"[ ()./-]")


def phone_number(text: object) -> str:
    if not isinstance(text, str):
        raise ConfigError(
            'write the number in quotes, such as "0,26204393": without them a leading 0 is lost'
        )
    if not _NUMBER.match(text):
        raise ConfigError(
            f"{shown(text)} is no telephone number: it has digits, and `,` for a pause, such as "
            '"0,2620-4393"'
        )
    return _LEFT_OUT.sub("", text).upper()


def init_strings(value: object) -> tuple[str, ...]:
    strings = [value] if isinstance(value, str) else value
    if not isinstance(strings, list):
        raise ConfigError(
            f"{shown(value)} is no init string: write it as ATZ, or several as a list"
        )
    for text in strings:
        if not isinstance(text, str) or not _INIT.match(text):
            raise ConfigError(f"{shown(text)} is no init string: it begins with AT, as in AT&F")
    return tuple(strings)


_INIT_SCHEMA = {"type": "string", "pattern": _INIT_PATTERN}


class ModemSection(BaseModel):
    """The modem at the port of a line, and its calls."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, defer_build=True)

    number: Annotated[
        str | None, Parsed(phone_number, {"type": "string", "pattern": NUMBER_PATTERN})
    ] = None
    """The telephone number of the PLCs, in quotes; a modem that only answers has none."""
    init: Annotated[
        tuple[str, ...],
        Parsed(init_strings, {"anyOf": [_INIT_SCHEMA, {"type": "array", "items": _INIT_SCHEMA}]}),
    ] = ("ATZ",)
    """Commands that set the modem up, one or a list."""
    dial_timeout: Interval = 60.0
    """The longest time from the dial to the carrier."""
    tries: Annotated[int, Field(ge=1, le=10)] = 3
    """The number of calls until the PLCs count as not reachable."""
    retry_pause: Interval = 10.0
    """The pause between two of them."""
    idle: Interval | None = None
    """The modem hangs up so long after the last exchange; left out: 5s, or 1min when it answers."""
    guard: Interval = 1.2
    """The silence before and after +++, which ends a call where DTR is missing."""
