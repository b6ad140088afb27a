"""Tags, their samples, and the latest sample of every tag."""

from gateway.tags.alarm import AlarmRule, Level
from gateway.tags.sample import Quality, Reason, Sample, WriteResult, bad, good, of_field
from gateway.tags.tag import Deadband, Form, Publish, Tag, WriteRule

__all__ = [
    "AlarmRule",
    "Deadband",
    "Form",
    "Level",
    "Publish",
    "Quality",
    "Reason",
    "Sample",
    "Tag",
    "WriteResult",
    "WriteRule",
    "bad",
    "good",
    "of_field",
]
