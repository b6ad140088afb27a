"""The order of everything that a line has to do."""
