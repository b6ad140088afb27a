"""Drivers and codecs: how the gateway reads and writes the devices of each protocol.

`driver.py` is the contract; `registry.py` lists the protocols; each has a folder of its own.
"""
