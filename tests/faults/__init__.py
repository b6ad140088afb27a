"""Faults with real processes, ports and cables."""
