"""Campaigns: many settings of one network, simulated into one labelled store that survives any interruption."""
