"""The commands of `plc-gateway`, and the Zenoh client that they use."""
