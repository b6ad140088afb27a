"""The rules of the engine: the consequences of a result."""
