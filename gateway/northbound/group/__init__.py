"""Gateways beside this one: claims of devices, and standby groups."""
