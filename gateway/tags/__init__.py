"""Tags, their samples, and the latest sample of every tag."""

from gateway.tags.sample import Quality, Reason, Sample, WriteResult, bad, good, of_field
from gateway.tags.tag import Deadband, Form, Publish, Tag, WriteRule

__all__ = [
    "Deadband",
    "Form",
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
