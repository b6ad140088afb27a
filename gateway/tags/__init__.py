"""Tags, their samples, and the latest sample of every tag."""

from gateway.tags.alarm import AlarmRule, Level, Priority
from gateway.tags.publishing import Deadband, Form, Publish, Publishing
from gateway.tags.sample import Quality, Reason, Sample, WriteResult, bad, good, of_field
from gateway.tags.tag import Label, Origin, Tag, WriteRule
