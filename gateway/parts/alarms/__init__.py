"""Alarms: the states of ISA-18.2 for tags, devices and lines, kept across restarts."""
