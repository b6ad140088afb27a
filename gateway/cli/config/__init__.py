"""Commands about the file: check it, make it."""
