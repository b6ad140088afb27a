"""Transfers: values that the gateway reads from one PLC and writes to another."""

from gateway.parts.transfers.runner import Transfers
