"""The requests that read all tags at the least wire time."""
