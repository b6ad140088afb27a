"""Certificates of Zenoh: the days that they have left, and those that were renewed."""
