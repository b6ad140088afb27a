"""The archive: the histories of all gateways below a prefix, each sample once, in one store."""
