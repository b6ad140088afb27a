"""Everything that the gateway puts on Zenoh by itself."""
