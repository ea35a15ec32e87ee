"""Relays that filter and forward: second moments, gains, power, receivers."""
