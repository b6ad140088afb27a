"""The state file: knowledge of devices, kept across restarts."""
