"""What follows from a result: the rules of the engine."""
