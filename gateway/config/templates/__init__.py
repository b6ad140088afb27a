"""Templates: devices that are written once, with parameters."""
