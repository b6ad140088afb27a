"""Mitsubishi FX: the protocol of the programming port, as it is publicly described."""
