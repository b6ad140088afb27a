"""The plant: its lines, the last sample of every tag, and the requests of clients."""
