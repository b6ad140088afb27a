"""Simulated plants: the stations of a configuration, served in memory, on TCP or on a pty."""
