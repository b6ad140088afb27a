"""Replies to queries, on threads."""
