"""Tests of the notification."""
