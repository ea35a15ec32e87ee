"""Recordings: rows of measurements and inputs of one network, whose times follow one another."""
