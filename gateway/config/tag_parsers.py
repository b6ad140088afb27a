"""Parsers of the settings of tags. Each is as those of `gateway.config.parsers`."""

import math
import re

from gateway.config.messages import one_of, shown
from gateway.errors import ConfigError
from gateway.tags import Deadband, Form, Publish

_PERCENT = re.compile(r"([0-9]+(?:\.[0-9]+)?) ?%\Z")


def deadband(text: object) -> Deadband:
    """Parses `0.5` (in the unit of the tag) or `2%` (of the last published value)."""
    if isinstance(text, (int, float)) and not isinstance(text, bool):
        if not 0 <= text < math.inf:
            raise ConfigError(f"{shown(text)}: a deadband is 0 or more")
        return Deadband(float(text))
    match = _PERCENT.match(text) if isinstance(text, str) else None
    if match is None:
        raise ConfigError(f"{shown(text)} is no deadband: write 0.5 (in the unit of the tag) or 2%")
    if float(match[1]) > 100:
        raise ConfigError(f"{text}: more than 100% would publish almost nothing")
    return Deadband(float(match[1]), percent=True)


def publish(text: object) -> Publish:
    if text not in list(Publish):
        raise ConfigError(f"{shown(text)} is not known: use {one_of(Publish)}")
    return Publish(str(text))


def form(text: object) -> Form:
    if text not in list(Form):
        raise ConfigError(f"{shown(text)} is not known: use {one_of(Form)}")
    return Form(str(text))
