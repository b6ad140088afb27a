"""The history file, and the thread that writes it."""
