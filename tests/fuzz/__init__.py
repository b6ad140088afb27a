"""What anybody may send: bytes to every codec, text to the configuration, payloads to writes."""
