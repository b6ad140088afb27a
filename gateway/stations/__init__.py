"""The other side: simulated PLCs, pure state machines that answer bytes with bytes."""
