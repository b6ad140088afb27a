"""The replying side of each protocol: simulated PLCs, pure state machines on bytes."""
