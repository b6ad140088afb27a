"""Arbitrary input: bytes to every codec, text to the configuration, payloads to writes."""
