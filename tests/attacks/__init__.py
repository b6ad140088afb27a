"""Attacks on the running gateway: each test is one fault of a device, a server or a link."""
