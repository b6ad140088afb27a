"""The plant on virtual time: hours of bus in seconds, the same every run."""
