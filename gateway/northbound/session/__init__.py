"""The Zenoh session: opened, watched, closed."""
