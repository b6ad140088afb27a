"""The asking side of every protocol.

`driver.py` is the contract; `registry.py` lists the protocols; each has a folder of its own.
"""
