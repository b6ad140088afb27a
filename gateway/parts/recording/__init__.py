"""Recordings of lines: written, read again, replayed."""
