"""Served lines: the gateway is a station of another master."""
