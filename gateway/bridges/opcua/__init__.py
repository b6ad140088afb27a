"""Serves the gateways to OPC UA clients."""
