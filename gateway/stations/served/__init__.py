"""Served stations: the gateway answers a master, and takes what the master writes."""
