"""Other history files: moved aside, backups, those of a stopped gateway."""
