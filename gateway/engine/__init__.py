"""The rules of one line, pure: the next job, and the effects of its result."""
