"""The bridge to a broker of MQTT."""
