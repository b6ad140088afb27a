"""Rights of clients: secrets, signatures, certificates."""
