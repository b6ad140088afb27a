"""Commands about the history on disk."""
