"""The life of the process: start, reload, parts, stop."""
