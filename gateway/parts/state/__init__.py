"""What the gateway has learned of its devices, kept across restarts."""
