"""Queries of the past: samples in memory and in the file."""
