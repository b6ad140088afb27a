"""One device of a line: its plan, its health and what was learned of it."""
