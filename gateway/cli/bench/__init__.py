"""The bench: a local page that goes from the cable to the tags in the file, without a terminal."""
