"""Commands that read and write sheets of tags."""
