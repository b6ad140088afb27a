"""A toy part: it greets. Only the list of parts names it."""
