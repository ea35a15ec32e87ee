"""Offline design: from system and network to gains, before any data."""
