"""The history: samples on disk, as long as the configuration says, found by tag and time."""
