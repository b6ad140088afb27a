"""Jobs that an engine hands to its line, requests of clients, and results."""
