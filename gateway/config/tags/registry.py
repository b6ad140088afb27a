"""The features of tags: a new one is a module and a line here."""

from gateway.config.tags.features import (
    alarm,
    bits,
    kept,
    label,
    layout,
    publishing,
    serving,
    shaping,
    writing,
)

FEATURES = (
    layout.FEATURE,
    label.FEATURE,
    shaping.FEATURE,
    kept.FEATURE,
    publishing.FEATURE,
    writing.FEATURE,
    alarm.FEATURE,
    serving.FEATURE,
    bits.FEATURE,
)
