"""Tags, their samples, and the last sample of every tag."""

from gateway.tags.tag import (
    Deadband,
    Form,
    Publish,
    Quality,
    Reason,
    Sample,
    Shape,
    Tag,
    WriteResult,
    WriteRule,
    bad,
    good,
    of_field,
)

__all__ = [
    "Deadband",
    "Form",
    "Publish",
    "Quality",
    "Reason",
    "Sample",
    "Shape",
    "Tag",
    "WriteRule",
    "WriteResult",
    "bad",
    "good",
    "of_field",
]
