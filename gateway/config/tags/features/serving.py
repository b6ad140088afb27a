"""Settings of a tag on a served line: docs/serve.md."""

from gateway.config.settings.setting_types import Text
from gateway.config.tags.features.feature import Feature, Settings


class ServingDefaults(Settings):
    hold_last: bool = False
    """On a served line: answer the master with the last good value instead of an error."""


class ServingSettings(Settings):
    source: Text | None = None
    """On a served line: the tag, as device/tag, whose value the master reads here."""
    retain: bool = False
    """On a served line: keep the value that clients wrote across restarts."""


FEATURE = Feature(defaults=ServingDefaults, own=ServingSettings)
